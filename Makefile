# `make demo` runs the whole loop and ends in a report; `make test` checks everything. Both set up from nothing, as all below do.
# `make test-portable` repeats the numerical tests as processors with fewer instructions would run them: tests/other_processors.py.
# `make test-wheel` builds the compiled wheel and runs every command from it.
# `make test-arm` runs the kernels as they are compiled for ARM, emulated: tests/arm.py.
# `make sanitize` runs the kernels under the address, undefined-behaviour and thread sanitizers: tests/sanitize.py.
# `make coverage` says which lines the tests reach, `make coverage-flight` fails where the tests of flight reach too few of its branches;
# `make docs` builds the documentation into build/docs.
OUT ?= demo
export OMP_WAIT_POLICY ?= passive

.PHONY: demo test test-portable test-wheel test-arm sanitize coverage coverage-flight docs setup clean

demo: setup
	.venv/bin/hil demo --out "$(OUT)" $(ARGS)

test: setup
	.venv/bin/ruff format --check .
	.venv/bin/ruff check .
	.venv/bin/clang-format --dry-run --Werror $$(git ls-files "obbgs_core/render/kernels/*.cpp" "obbgs_core/render/kernels/*.h")
	.venv/bin/pyright
	.venv/bin/pytest -n 3 --dist loadfile $(ARGS)

test-portable: setup
	.venv/bin/python -m tests.other_processors $(ARGS)

test-arm: setup
	.venv/bin/python -m tests.arm

sanitize: setup
	.venv/bin/python -m tests.sanitize $(ARGS)

test-wheel: setup
	rm -rf build/wheel
	.venv/bin/pip wheel -q --disable-pip-version-check --no-deps -w build/wheel $(PIP_ARGS) .
	OBBGS_WHEEL=$$(ls build/wheel/*.whl) .venv/bin/pytest -q tests/test_packaging.py -k wheel $(ARGS)

coverage: setup
	.venv/bin/pytest -n 3 --dist loadfile --cov --cov-report=term:skip-covered --cov-report=html:build/coverage $(ARGS)

coverage-flight: setup
	mkdir -p build
	.venv/bin/pytest -q -n 3 --dist loadfile --cov=flightsw --cov-branch --cov-report=json:build/coverage-flight.json tests/flightsw tests/hil/test_gige.py $(ARGS)
	.venv/bin/python -m tests.branch_coverage build/coverage-flight.json 95

docs: .venv-docs/.ready
	NO_MKDOCS_2_WARNING=1 .venv-docs/bin/mkdocs build --strict --site-dir build/docs

.venv-docs/.ready: docs/requirements.txt
	$(or $(PYTHON),python3) -m venv .venv-docs
	.venv-docs/bin/pip install -q --disable-pip-version-check $(PIP_ARGS) -r docs/requirements.txt
	touch $@

setup:
	@./setup.sh

clean:
	rm -rf .venv .venv-blender .venv-docs build
