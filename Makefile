# The commands a person runs are the ones CI runs. PYTHON is any Python from 3.11.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := PIP_CONSTRAINT=constraints.txt $(BIN)/python -m pip install --quiet --disable-pip-version-check

NETWORKS := checkpoints/stsr.pt checkpoints/stsr-small.pt checkpoints/mtsr.pt

.PHONY: run test night lint docs wheels models reports reports-stale clean

run: $(VENV)/.runtime  ## environment, runtime alone, demo on the live page
	$(BIN)/edge-sr demo --view

test: $(VENV)/.dev  ## everything else, all tests; three at a time on two cores, since many mostly wait, and the soak beside
	@$(BIN)/python -m pytest -q -m soak -p no:cacheprovider tests/system/test_chaos.py & soak=$$!; \
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 3 --dist loadfile --no-loadscope-reorder -m "not soak and not night"; tests=$$?; \
	wait $$soak && test $$tests = 0

night: $(VENV)/.dev  ## the tests that train and export for minutes
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile -m night

lint: $(VENV)/.dev  ## format, lint, types, import rules
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright
	$(BIN)/lint-imports

docs: $(VENV)/.docs  ## README.md, docs/ and reports/ as a site, in site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

wheels: $(VENV)/.wheels  ## two wheels in dist/: the runtime, with completion and man page; and training, export, bench
	$(BIN)/python release/wheels.py

PRESSES := data/gripped.npz data/taps4.npz data/taps7.npz
TURNED := data/turned7.npz
FIGURES := data/named4.npz data/named7.npz data/nominal4.npz data/nominal7.npz

models: $(VENV)/.dev $(PRESSES) $(TURNED) $(FIGURES) data/validation.npz  ## train the bundled models on, and export them again
	$(BIN)/python -m train.fit checkpoints --data $(PRESSES) $(FIGURES) --validation data/validation.npz
	$(BIN)/python -m export.to_onnx $(NETWORKS) --out edge/models --validation data/validation.npz --intervals $(PRESSES) $(TURNED) --trust edge/models/stsr-int8.onnx
	$(BIN)/python -m export.to_onnx $(NETWORKS) --out edge/models --validation data/validation.npz --intervals $(PRESSES) $(TURNED) --trust edge/models/stsr-int8.onnx --int8 $(PRESSES)
	$(BIN)/python -m train.freeze edge/models --data $(PRESSES)
	$(BIN)/python -m export.verify edge/models/*.onnx

REPORT := nice $(BIN)/python

reports: $(VENV)/.dev  ## every report: days on two cores; each command stands alone, too
	$(REPORT) -m train.experiments all
	$(REPORT) -m export.verify edge/models/*.onnx --out reports/parity.md
	$(BIN)/edge-sr bench --out reports
	$(REPORT) tests/system/mutation_survey.py --out reports/mutation.md

reports-stale: $(VENV)/.dev  ## a line for each report: fresh, or stale and why
	@$(BIN)/python -m edge.bench.provenance

data/gripped.npz: $(VENV)/.dev  ## presses of every family, on pads of their own
	$(BIN)/python -m train.data.make_presses $@ --count 24000 --per-pad 48 --seed 67

data/taps4.npz: $(VENV)/.dev  ## four taps each, from poses of every kind
	$(BIN)/python -m train.data.make_presses $@ --count 8000 --taps 4 --seed 66

data/taps7.npz: $(VENV)/.dev  ## the same, seven taps each
	$(BIN)/python -m train.data.make_presses $@ --count 2500 --taps 7 --seed 65

data/turned7.npz: $(VENV)/.dev  ## seven taps turned by 5 degrees each, by which intervals hold for these, too
	$(BIN)/python -m train.data.make_presses $@ --count 1200 --taps 7 --schedule turns --seed 69

data/named4.npz: $(VENV)/.dev  ## the paper's figures, four taps each
	$(BIN)/python -m train.data.make_presses $@ --families paper --count 5000 --taps 4 --seed 63

data/named7.npz: $(VENV)/.dev  ## the same, seven taps each
	$(BIN)/python -m train.data.make_presses $@ --families paper --count 1500 --taps 7 --seed 64

data/nominal4.npz: $(VENV)/.dev  ## the same as the paper has it: one pad, turned by 5 degrees from tap to tap
	$(BIN)/python -m train.data.make_presses $@ --families paper --count 3000 --taps 4 --schedule turns --spread 0 --seed 61

data/nominal7.npz: $(VENV)/.dev  ## the same, seven taps each
	$(BIN)/python -m train.data.make_presses $@ --families paper --count 2000 --taps 7 --schedule turns --spread 0 --seed 62

data/validation.npz: $(VENV)/.dev  ## as many of each family, on other pads, to set things by
	$(BIN)/python -m train.data.make_presses $@ --families even --count 2520 --per-pad 10 --taps 7 --seed 1000001

$(VENV)/.runtime: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP) --editable .
	touch $@

$(VENV)/.dev: $(VENV)/.runtime
	$(PIP) --editable '.[dev]'
	touch $@

$(VENV)/.wheels: $(VENV)/.runtime
	$(PIP) --editable '.[wheels]'
	touch $@

$(VENV)/.docs: $(VENV)/.runtime
	$(PIP) --editable '.[docs]'
	touch $@

clean:
	rm -rf $(VENV) site .pytest_cache .ruff_cache .hypothesis
