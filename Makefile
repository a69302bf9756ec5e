# `make demo` and `make test` do all the set-up they need on a fresh machine (Debian 12, python3, make).
PYTHON ?= python3
BIN := .venv/bin
# Without bytecode each process would compile what it imports.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: setup demo test all-tests unit random lint style types bench soak ghosts hostile golden docs lock packages test-packages deb vm-packages vm-test kiosk-test promise-test clean

setup: .venv/.ready

# Everything at the exact versions of requirements.lock; touchd itself is installed in place.
.venv/.ready: requirements.lock pyproject.toml | packages
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --no-deps --no-build-isolation -e .
	touch $@

packages:
	@deploy/debian-packages.sh run

# After `packages`, as apt runs once at a time.
test-packages: packages
	@deploy/debian-packages.sh test
	@sh docs/examples/install-node-zeromq.sh
	@sh docs/examples/install-node-zeromq.sh tests/system/web

demo: setup
	@$(BIN)/touchd demo $(ARGS)

# The tests of a file stay together, for what they share; the order is that of pyproject's `testpaths`.
SIDE_BY_SIDE := --dist loadscope --no-loadscope-reorder --numprocesses

# Everything; some minutes. The set-up waits for the network in two ways at once, and mypy works on one processor alone.
test:
	@$(MAKE) --no-print-directory --jobs 2 setup test-packages
	@$(MAKE) --no-print-directory style
	@$(MAKE) --no-print-directory --jobs 2 types all-tests

# Two more side by side than there are processors: they often wait for processes they started.
all-tests:
	$(BIN)/python -m pytest $(SIDE_BY_SIDE) $(shell expr $$(nproc) + 2) $(ARGS)

# What needs no other process, socket of the network or kernel, on a quarter of the random examples: under a minute.
unit: setup
	$(BIN)/python -m pytest $(SIDE_BY_SIDE) auto --hypothesis-profile=quick tests/unit $(ARGS)

# The same tests on random examples, others in each run: what fails here was wrong before.
random: setup
	$(BIN)/python -m pytest $(SIDE_BY_SIDE) auto --hypothesis-profile=random tests/unit $(ARGS)

# The Debian package, in dist/. DEBIAN=13 and ARCH=arm64 make one for another system; only the default is tried.
deb: setup
	@DEBIAN=$(DEBIAN) ARCH=$(ARCH) deploy/build-deb.sh $(BIN)/python

# After `test-packages`, for the same reason.
vm-packages: test-packages
	@deploy/debian-packages.sh vm

# The package in a virtual machine with the kernel's own USB; the machine is made once and kept in ~/.cache/touchd-vm.
vm-test: setup vm-packages
	$(BIN)/python -m pytest -o faulthandler_timeout=2500 tests/system/vm/scenario.py $(ARGS)

# The touch screen under Weston and Xorg, as a page in Chromium hears it, and an audio interface on a loopback card: a
# quarter of an hour on an idle machine, and ten minutes more for a new virtual one.
kiosk-test: setup vm-packages
	$(BIN)/python -m pytest -s -o faulthandler_timeout=5500 tests/system/kiosk/scenario.py $(ARGS)

# From a bare plate to a page that hears touches, in the same: calibration, wizard, screen.
promise-test: setup vm-packages
	$(BIN)/python -m pytest -s -o faulthandler_timeout=7300 tests/system/kiosk/promise.py $(ARGS)

lint: setup
	@$(MAKE) --no-print-directory style types

style:
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types:
	$(BIN)/mypy

# Time against error, beside the bare network in the same process.
bench: setup
	$(BIN)/touchd benchmark

# A million frames at full speed, then ten minutes at 1000 a second, with faults: some 15 minutes.
soak: setup
	$(BIN)/python -m tests.system.soak $(ARGS)

# Ten hours of drift, tones, drops, palms and touches: prints every contact that should not be. Half an hour.
ghosts: setup
	$(BIN)/python -m tests.system.soak.ghosts $(ARGS)

# Strangers on every interface, in full: some minutes. Prints memory, descriptors and counts.
hostile: setup
	$(BIN)/python -m pytest tests/system/hostile --hostile=full --hypothesis-profile=random -s $(ARGS)

# Rebuild the checked-in results and pages.
golden: setup
	$(BIN)/python -m tests.scenes.golden.rebuild

docs: setup
	$(BIN)/python -m docs.generate
	$(BIN)/touchd draw touchd/demo/session.npz -o docs/session.png

lock: setup
	$(BIN)/pip-compile --quiet --all-extras --strip-extras --no-emit-index-url --no-emit-find-links \
		--no-emit-trusted-host --allow-unsafe --output-file requirements.lock pyproject.toml
	# Any build of this torch will do: which libraries it brings depends on the machine.
	sed -i 's/^\(torch==[0-9.]*\)+.*/\1/' requirements.lock

clean:
	rm -rf .venv build dist .mypy_cache .pytest_cache .ruff_cache .hypothesis
