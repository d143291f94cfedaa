"""How often the flight software was started on a store: each start has a number, by which its counts are told apart."""

import logging
import secrets
from pathlib import Path

from flightsw.storage.store import RESERVE, write_with_reserve
from obbgs_base.checked import read_twice, write_twice
from obbgs_base.errors import in_words

log = logging.getLogger(__name__)
LOST = 1 << 31  # a number from here on was drawn at random, since the last one could not be read or kept


def count_boot(folder: Path) -> int:
    """Return the number of this start, one more than the last: 1 for the first one on a store.

    It stands twice in the store's folder, with a checksum. Where neither copy is good, or the disk does not take the
    number, it is drawn at random from `LOST` to 2**32 - 1, so that it differs from that of the last start.
    """
    path = folder / "boots.json"
    try:
        known = read_twice(path, log.warning)
        boot = 1 if known is None else (int(known["boot"]) + 1) % (1 << 32)
    except (OSError, ValueError, KeyError, TypeError) as error:
        boot = LOST + secrets.randbits(31)
        log.error("the number of starts is lost, it goes on from %d: %s", boot, in_words(error))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_twice(path, {"boot": boot}, lambda file, data: write_with_reserve(file, data, folder / RESERVE))
    except OSError as error:
        boot = LOST + secrets.randbits(31)
        log.error("the number of this start cannot be kept, %d stands for it: %s", boot, in_words(error))
    return boot
