"""The gate on branches: python -m tests.branch_coverage REPORT PERCENT, with the report of coverage.py as JSON.

Of pytest-cov's own limit lines are a part too, and most of it.
"""

import argparse
import json
from pathlib import Path

SHOWN = 10  # files with the most branches that no test takes


def main() -> None:
    parser = argparse.ArgumentParser(description="Fail where tests take too few of the branches.")
    parser.add_argument("report", type=Path, help="of coverage.py, as JSON")
    parser.add_argument("percent", type=float, help="of the branches that tests must take")
    arguments = parser.parse_args()
    report = json.loads(arguments.report.read_text())
    taken, count = (report["totals"][name] for name in ("covered_branches", "num_branches"))
    files = {name: file["missing_branches"] for name, file in report["files"].items()}
    for name in sorted(files, key=lambda name: -len(files[name]))[:SHOWN]:
        lines = ", ".join(f"{start} to {end}" for start, end in files[name][:8])
        print(f"{len(files[name]):3d} branches not taken in {name}: {lines}")
    percent = 100 * taken / count
    print(f"tests take {percent:.1f} % of {count} branches, {arguments.percent:g} % are asked for")
    if percent < arguments.percent:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
