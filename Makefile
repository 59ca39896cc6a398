# make demo: everything from nothing to pictures. make check test: what CI runs. make chaos: faults (docs/guarantees.md).
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV ?= .venv
BIN := $(VENV)/bin
TESTS := $(BIN)/python -m pytest --quiet --numprocesses auto --dist worksteal
SIZE_demo := 310 MB to load, 1.0 GB on disk
SIZE_docs := 100 MB to load, 400 MB on disk
SIZE_dev := 670 MB to load, 2.4 GB on disk

# make quick: unit tests that are not slow, in about a minute. make test: the proof. make nightly, make weekly: what
# takes longer (CONTRIBUTING.md).
.PHONY: venv demo quick test nightly weekly check docs lint-page chaos fuzz soak bench bundle

venv: $(VENV)/.dev

demo: $(VENV)/.demo
	@$(BIN)/sitegrid demo --web

# An extra of this project and all that it needs, without the 150 MB of PyBullet's examples. pip is silent while it
# unpacks: a terminal shows how far it is.
$(VENV)/.%: pyproject.toml constraints.txt
	@"$(PYTHON)" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null || { \
		echo "Python 3.11, 3.12 or 3.13 is needed, and '$(PYTHON)' is" \
		"$$("$(PYTHON)" --version 2>&1 | grep -x 'Python [0-9.]*' || echo none): say make PYTHON=/path/to/python3" >&2; exit 1; }
	@echo "Installing into $(VENV): $(SIZE_$*)"
	@began=$$(date +%s); \
	{ [ ! -t 1 ] || while kill -0 $$$$ && sleep 1; do \
		printf '\r  %s s, %s MB ' $$(($$(date +%s) - began)) "$$(du -sm $(VENV) | cut -f1)"; done; } 2>/dev/null & \
	"$(PYTHON)" -m venv $(VENV) && mkdir -p $(VENV)/tmp && \
	TMPDIR=$(abspath $(VENV))/tmp $(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt \
		--config-settings editable_mode=compat --editable '.[$*]' && \
	rm -rf $(VENV)/lib/python3*/site-packages/pybullet_*; \
	status=$$?; kill $$! 2>/dev/null; rm -rf $(VENV)/tmp; echo; exit $$status
	@touch $@ $(if $(filter dev,$*),$(VENV)/.demo $(VENV)/.docs)

quick: venv
	$(TESTS) -m "not slow and not processes and not nightly" tests/unit

test: venv
	$(TESTS) --durations 15 -m "not nightly" --ignore tests/house tests

nightly: venv
	$(BIN)/python -m tests.nightly

weekly: venv
	$(BIN)/python -m tests.nightly --weekly

check: venv
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m pytest --quiet tests/house
	@if command -v npm >/dev/null; then $(MAKE) --no-print-directory lint-page; \
	else echo "no npm: the live page's JavaScript is not checked; install it, for example with apt-get install npm"; fi

# The documents as pages, with a search and the API: build/docs/docs/index.html. A warning is an error.
docs: $(VENV)/.docs
	$(BIN)/sphinx-build --quiet --fail-on-warning -c docs . build/docs

# The live page's JavaScript; npm installs what checks it, as the lock file says.
lint-page: tests/page/node_modules/.package-lock.json
	tests/page/node_modules/.bin/eslint --config tests/page/eslint.config.mjs sitegrid/web/page

tests/page/node_modules/.package-lock.json: tests/page/package.json tests/page/package-lock.json
	npm ci --loglevel error --no-audit --no-fund --prefix tests/page
	@touch $@

chaos: venv
	$(BIN)/python -m tests.chaos

fuzz: venv
	$(BIN)/python -m tests.fuzz --seconds 300

soak: venv
	$(BIN)/python -m tests.soak

# A folder of wheels for hosts without a network (docs/operation.md): of this computer's kind and version of Python. Its
# requirements.txt has the hash of each.
OF ?= agent,can,postgres,receivers,security,server,web
WHEELS ?= wheels
bundle:
	rm -rf build # else modules that are gone would be in it
	"$(PYTHON)" -m pip wheel --quiet --disable-pip-version-check --constraint constraints.txt --wheel-dir '$(WHEELS)' '.[$(OF)]'
	cd '$(WHEELS)' && sha256sum *.whl | awk '{split($$2, part, "-"); print part[1] "==" part[2] " --hash=sha256:" $$1}' > requirements.txt

bench: venv
	$(BIN)/python -m lab speed merge
	$(BIN)/python -m lab speed ingest
	$(BIN)/python -m lab speed fleet
	$(BIN)/python -m lab speed live
	$(BIN)/python -m lab speed query
	$(BIN)/python -m lab speed restart
	$(BIN)/python -m lab speed filter
	$(BIN)/python -m lab speed sim
