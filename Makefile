PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
RUN := runs/quickstart
# The proofs: a thread a process. The user's world has no variable set, and its tests start processes of their own.
PROOFS := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal -rs --ignore=tests/user
AS_USER := $(BIN)/python -m pytest -rs tests/user
EVERYWHERE := --jaxtyping-packages=bpnp,beartype.beartype
# Percent of lines and branches that the tests run; compiled loops are not counted.
FLOOR := 88

.PHONY: quickstart show-report check test nightly coverage results lint docs notebooks wheel install clean

install: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(None if v >= (3, 11) else "Python %d.%d is too old, 3.11 or later is needed; try: make PYTHON=python3.11" % v)'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

quickstart: install
	$(BIN)/bpnp fit --config quickstart --model.weights procedural-euler
	$(BIN)/bpnp fit --config quickstart --model.weights procedural-euler --pose_loss.start_epoch 6 --trainer.default_root_dir $(RUN)_lc
	$(BIN)/bpnp test --config quickstart --ckpt_path $(RUN)_lc/checkpoints/last.ckpt --results.folder $(RUN)/Lc
	$(BIN)/bpnp test --config quickstart --ckpt_path $(RUN)/checkpoints/last.ckpt --results.folder $(RUN)/LcLp
	$(BIN)/bpnp report $(RUN)/Lc $(RUN)/LcLp --html $(RUN)/report.html --curves $(RUN)/curves.png
	@$(MAKE) --no-print-directory show-report

# In the browser where there is a display, and not in continuous integration, which sets CI.
show-report:
	@echo "report: $(CURDIR)/$(RUN)/report.html"
	@if [ -n "$$DISPLAY$$WAYLAND_DISPLAY" ] && [ -z "$$CI" ]; then \
		$(PYTHON) -m webbrowser "file://$(CURDIR)/$(RUN)/report.html" > /dev/null 2>&1 || true; fi

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

check: lint
	$(PROOFS) -m "not slow and not nightly"

test: lint
	$(PROOFS) -m "not nightly"
	$(AS_USER) -m "not nightly"

# What `make test` leaves out. The types of the whole package are checked, also in the quick proofs of the parts whose
# types `make test` does not check.
nightly: install
	$(PROOFS) $(EVERYWHERE) -m "nightly"
	$(AS_USER) -m "nightly"
	$(PROOFS) $(EVERYWHERE) -m "not slow and not nightly" tests/search tests/maps tests/report tests/datamodules

coverage: lint
	$(PROOFS) --cov --cov-report=term --cov-fail-under=$(FLOOR)

results: install
	$(BIN)/python -m benchmarks results --quick --check

docs: install
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[docs]'
	$(BIN)/mkdocs build --strict --site-dir build/site

notebooks: install
	$(BIN)/python examples/store_outputs.py

wheel: install
	$(BIN)/python -m pip wheel --quiet --disable-pip-version-check --no-deps --wheel-dir dist .
	$(PYTHON) -m venv --clear build/empty
	build/empty/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt dist/bpnp-*.whl
	cp examples/wheel.py build/empty && cd build/empty && bin/bpnp --version && bin/python wheel.py
	cd build/empty && bin/bpnp solve points2d.csv points3d.csv --camera camera.csv --picture pose.png
	cd build/empty && bin/bpnp fit --config quickstart --config presets/debug
	cd build/empty && bin/bpnp test --config quickstart --config presets/debug --ckpt_path last
	cd build/empty && bin/bpnp report runs/debug/test
	build/empty/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt "$$(ls dist/bpnp-*.whl)[dashboards]"
	cd build/empty && bin/bpnp report runs/debug/test --html report.html

clean:
	rm -rf $(VENV) runs .cache build dist
