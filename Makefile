# The commands a person runs are the ones CI runs. PYTHON is any Python from 3.11.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := PIP_CONSTRAINT=constraints.txt $(BIN)/python -m pip install --quiet --disable-pip-version-check

NETWORKS := checkpoints/stsr.pt checkpoints/stsr-small.pt checkpoints/mtsr2.pt checkpoints/mtsr4.pt

.PHONY: run test lint models clean

run: $(VENV)/.runtime  ## environment, runtime alone, demo
	$(BIN)/edge-sr --source demo

test: $(VENV)/.dev  ## everything else, all tests; the soak, which mostly waits, beside the others
	@$(BIN)/python -m pytest -q -m soak & soak=$$!; \
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile -m "not soak"; tests=$$?; \
	wait $$soak && exit $$tests

lint: $(VENV)/.dev  ## format, lint, types, import rules
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright
	$(BIN)/lint-imports

models: $(VENV)/.dev data/seen.npz data/figures.npz  ## retrain and re-export the bundled models: about an hour on two cores
	$(BIN)/python -m train.freeze edge/models --data data/seen.npz data/figures.npz
	$(BIN)/torchrun --nproc-per-node 2 -m train.fit checkpoints --data data/seen.npz data/figures.npz
	$(BIN)/python -m export.to_onnx $(NETWORKS) --out edge/models --batch any --int8 data/seen.npz data/figures.npz --fine-tune-steps 3000
	$(BIN)/python -m export.verify edge/models/*.onnx

data/seen.npz: $(VENV)/.dev  ## taps on the 18 surfaces
	$(BIN)/python -m train.generate $@ --taps 7 --seed 1

data/figures.npz: $(VENV)/.dev  ## taps on random figures
	$(BIN)/python -m train.generate $@ --surfaces none --glyphs 4500 --polygons 4500 --taps 7 --seed 2

$(VENV)/.runtime: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP) --editable .
	touch $@

$(VENV)/.dev: $(VENV)/.runtime
	$(PIP) --editable '.[dev]'
	touch $@

clean:
	rm -rf $(VENV) .pytest_cache .ruff_cache .hypothesis
