"""Whether the tests notice a changed line: python -m tests.benchmarks.mutations [--count N] [--seed N] [--done FILE]

Changes one line after the other of the flight software and of the training, chosen at random, and runs the tests of its
part until the first that fails. It works in the checkout itself, which must have no changes, and puts each file back as
it was. `--done` names a file of finished trials, from which an interrupted run goes on.
"""

import argparse
import ast
import json
import random
import subprocess
import sys
from pathlib import Path

PARTS = {
    "flightsw": ["tests/flightsw", "tests/hil"],
    "obbgs_core/train": ["tests/obbgs_core", "tests/ground/test_reconstruct.py"],
}
LIMIT_S = 3600

SWAPPED = {
    ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult,
    ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip


def changed(node: ast.AST) -> ast.AST | None:
    """Return another node in the place of this one that does something else, or None where none is known."""
    if isinstance(node, ast.Compare) and type(node.ops[0]) in SWAPPED:
        return ast.Compare(node.left, [SWAPPED[type(node.ops[0])](), *node.ops[1:]], node.comparators)
    if isinstance(node, ast.BinOp) and type(node.op) in SWAPPED and not isinstance(node.left, ast.JoinedStr):
        return ast.BinOp(node.left, SWAPPED[type(node.op)](), node.right)
    if isinstance(node, ast.BoolOp):
        return ast.BoolOp(SWAPPED[type(node.op)](), node.values)
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        return node.operand
    if isinstance(node, ast.Constant) and isinstance(node.value, bool):
        return ast.Constant(not node.value)
    if isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        return ast.Constant(node.value + 1)
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
        return ast.Pass()
    return None


def places(path: Path) -> list[tuple[int, ast.AST, ast.AST]]:
    """Return line, node and its change for all that can be changed inside the functions of a file, one of each line."""
    found = {}
    for function in ast.walk(ast.parse(path.read_text())):
        if not isinstance(function, ast.FunctionDef):
            continue
        for statement in function.body:
            for node in ast.walk(statement):
                other = changed(node)
                if other is not None and node.lineno == node.end_lineno:
                    found.setdefault(node.lineno, (node.lineno, node, other))
    return list(found.values())


def with_change(text: str, node: ast.AST, other: ast.AST) -> str:
    """Return the text of a file with one node replaced; columns of the syntax tree count bytes."""
    lines = text.splitlines(keepends=True)
    line = lines[node.lineno - 1].encode()
    new = ast.unparse(ast.fix_missing_locations(other))
    new = new if isinstance(other, ast.Pass) else f"({new})"
    lines[node.lineno - 1] = (line[: node.col_offset] + new.encode() + line[node.end_col_offset :]).decode()
    return "".join(lines)


def trial(path: Path, tests: list[str], draw: random.Random) -> dict:
    """Change a line of a file, run the tests, put the file back, and say what was seen."""
    before = path.read_text()
    line, node, other = draw.choice(places(path))
    after = with_change(before, node, other)
    result = {"file": str(path), "line": line, "was": before.splitlines()[line - 1].strip()}
    result["became"] = after.splitlines()[line - 1].strip()
    try:
        path.write_text(after)
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests]
        run = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S)
        result |= {"caught": run.returncode != 0, "said": run.stdout.strip().splitlines()[-1:]}
    except subprocess.TimeoutExpired:
        result |= {"caught": True, "said": ["the tests did not end"]}
    finally:
        path.write_text(before)
    return result


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--count", type=int, default=20)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--done", type=Path, default=Path("mutations.jsonl"))
    asked = options.parse_args()
    if subprocess.run(["git", "diff", "--quiet", "HEAD"]).returncode:
        raise SystemExit(
            "the checkout has changes: commit them first, because files are changed and put back here"
        )
    done = asked.done.read_text().splitlines() if asked.done.is_file() else []
    for number in range(asked.count):
        draw = random.Random(f"{asked.seed} {number}")
        part = list(PARTS)[number % len(PARTS)]
        files = [
            p for p in sorted(Path(part).rglob("*.py")) for _ in places(p)
        ]  # each place is as likely as another
        if number < len(done):
            continue
        result = {"seed": asked.seed, "number": number} | trial(draw.choice(files), PARTS[part], draw)
        with asked.done.open("a") as log:
            log.write(json.dumps(result) + "\n")
        print(json.dumps(result), flush=True)
    results = [json.loads(line) for line in asked.done.read_text().splitlines()]
    print(f"{sum(r['caught'] for r in results)} of {len(results)} changes were caught")


if __name__ == "__main__":
    main()
