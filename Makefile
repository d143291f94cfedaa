# Two commands: `make demo` runs the whole loop and ends in a report; `make test` checks everything. Both set up from nothing.
# `make test-portable` repeats the numerical tests as processors with fewer instructions would run them: tests/other_processors.py.
OUT ?= demo
export OMP_WAIT_POLICY ?= passive

.PHONY: demo test test-portable setup clean

demo: setup
	.venv/bin/hil demo --out "$(OUT)" $(ARGS)

test: setup
	.venv/bin/ruff format --check .
	.venv/bin/ruff check .
	.venv/bin/pyright
	.venv/bin/pytest -n 2 --dist loadfile $(ARGS)

test-portable: setup
	.venv/bin/python -m tests.other_processors $(ARGS)

setup:
	@./setup.sh

clean:
	rm -rf .venv .venv-blender build
