# `make demo` and `make test` each work alone on a new machine with Python 3.11+ and nothing else.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1
# Empty: modules are compiled once, not by every process, whatever the shell says (pip leaves that to Python).
export PYTHONDONTWRITEBYTECODE =

.PHONY: demo test suite answers lint types docs pictures benchmarks install lock clean

install: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit("boresight needs Python 3.11 or newer, found %d.%d" % sys.version_info[:2] if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --no-compile --require-hashes --requirement constraints.txt
	$(BIN)/python -m pip install --quiet --no-compile --no-deps --no-build-isolation --editable .
	$(BIN)/python scripts/import_all.py
	touch $@

# The pinned versions anew, after a change of pyproject.toml; `make lock UPGRADE=--upgrade` takes the newest.
lock: install
	$(BIN)/python -m pip install --quiet uv
	$(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-annotate $(UPGRADE) \
	  --custom-compile-command 'make lock' --extra dev --extra docs pyproject.toml --output-file constraints.txt
	$(BIN)/python scripts/plain_constraints.py

demo: install
	$(BIN)/boresight calibrate fixtures/mini --out demo-result
	$(BIN)/boresight validate demo-result --dump fixtures/mini

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: install
	$(BIN)/mypy

test: lint
	$(MAKE) --jobs 2 types suite

# Files with tests that `-m timed` chooses: no other need be imported for them.
TIMED = $(shell grep -rl 'mark\.timed' tests --include='*.py')

suite: install
	$(BIN)/pytest -n 2 --dist worksteal -m "not timed"  # neighbours share a process, and their module's fixtures
	$(BIN)/pytest -m timed $(TIMED)  # ratios of CPU times, with nothing beside that takes caches and clock

# All recorded answers of real star images, before a change of star_id is finished; `make suite` asks for a third.
answers: install
	EVERY_FRAME=1 $(BIN)/pytest -n 2 --dist worksteal tests/star_id/test_known_answers.py tests/star_id/test_real_images.py

docs: install
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# Pictures, recordings and printed results of README and docs from the present code; Chromium and pdftoppm draw.
# Those of real data are drawn where these are (scripts/figures/real_mission.py).
pictures: install
	$(BIN)/python scripts/refresh_tutorial.py
	for figure in frames plan report sky_trace star_camera_plan star_path strip_form strip_timing target_path terminal; do \
	  $(BIN)/python scripts/figures/$$figure.py || exit 1; done

# One table of all figures, benchmarks/results/table.md: half an hour on two idle cores. What a machine lacks is not run.
benchmarks: install
	$(BIN)/python benchmarks/run.py

clean:
	rm -rf $(VENV) build demo-result site
