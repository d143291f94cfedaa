"""The stateful model of frames for a night: python -m tests.nightly_model [--rules 100000]"""

import argparse
import logging

from tests.frame_model import run_model

STEPS = 50  # of one example


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rules", type=int, default=100_000, help="how many rules to run at least")
    rules, wanted = 0, parser.parse_args().rules
    logging.disable(logging.CRITICAL)  # what the model makes go wrong on purpose
    while rules < wanted:
        rules += run_model(examples=100, steps=STEPS)
        print(f"{rules} rules, every invariant holds", flush=True)


if __name__ == "__main__":
    main()
