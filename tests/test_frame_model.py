"""The stateful model of store, transfer, commands and session: some of it in each run, all of it by night."""

import logging

from tests.frame_model import run_model


def test_every_frame_is_received_on_board_or_counted_whatever_happens():
    logging.disable(logging.CRITICAL)
    try:
        assert run_model(examples=25, steps=40) > 500
    finally:
        logging.disable(logging.NOTSET)
