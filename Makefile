# make demo: the program on a real drive.  make test: everything that must hold.  make docs: the pages as a site.
# make clean: away with what they made.
PYTHON ?= python3
JOBS ?= 2
VENV := .venv
BIN := $(VENV)/bin

# the matrices are small: threads would only wait for each other
export OPENBLAS_NUM_THREADS := 1

# bytecode as well is kept: every program that the tests start would compile its imports again
unexport PYTHONDONTWRITEBYTECODE

# uv installs in a fifth of the time, where it can be had and finds the packages
install = ($(BIN)/pip install --quiet uv && \
	$(BIN)/uv pip install --quiet --system-certs --python $(BIN)/python -e '.[$(EXTRAS)]') 2>/dev/null || \
	$(BIN)/pip install --quiet -e '.[$(EXTRAS)]'

# machine code of the filter and the smoother, kept on disk
COMPILE := $(BIN)/python -c "from graphnav import load, run; run(load('data/tokyo').crop(0.0, 60.0))"

.PHONY: demo test check suite compile collect docs clean

demo: $(VENV)/installed
	$(BIN)/graphnav compare kitti --without gnss:400-460 -o out/demo

# side by side: check has the core that compile leaves idle
test: $(VENV)/installed-dev
	@$(MAKE) --no-print-directory -j$(JOBS) suite check

# compiled before, machine code and the tests themselves, or every worker would compile the same
suite: compile collect
	$(BIN)/pytest -n $(JOBS) --dist worksteal

compile: $(VENV)/installed-dev
	@$(COMPILE)

collect: $(VENV)/installed-dev
	@$(BIN)/pytest --collect-only >/dev/null || true  # the suite says what fails

check: $(VENV)/installed-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

docs: $(VENV)/installed-dev
	$(BIN)/mkdocs build
	@echo "build/site/index.html"

# Stamps: installed again only when pyproject.toml has changed.
$(VENV)/installed: EXTRAS := fast,plots
$(VENV)/installed: pyproject.toml
	@echo "installing graphnav and what it needs into $(VENV), once: about 800 MB, a minute or two"
	$(PYTHON) -m venv $(VENV)
	$(install)
	@echo "compiling the filter and the smoother, once"
	@$(COMPILE)
	@touch $@

$(VENV)/installed-dev: EXTRAS := dev
$(VENV)/installed-dev: pyproject.toml
	@echo "installing what the tests need as well into $(VENV), once"
	$(PYTHON) -m venv $(VENV)
	$(install)
	@touch $(VENV)/installed $@

clean:
	rm -rf $(VENV) out build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
