# Stereo 3D detection in INT8: everything from a fresh clone to the figures. `make` alone lists the targets.

PRESET ?= compact
CHECKPOINT ?= edge/zoo/$(PRESET).safetensors
PRIORS ?= $(if $(filter edge/zoo/%,$(CHECKPOINT)),edge/zoo/$(PRESET)-priors.npz)
KITTI ?=
SOURCE ?= $(if $(KITTI),kitti-object:$(KITTI)?split=val,$(DEMO_DRIVE))
MODEL ?=
OUT ?= out
START ?= $(if $(BACKBONE),,$(wildcard edge/zoo/$(PRESET).safetensors))
BACKBONE ?=
FRAMES ?= 2000
STEPS ?= 10000
DEVICE ?= cpu
PYTHON ?= python3.11 python3 python3.12 python3.13 python3.14

VENV := .venv
SLIM := .venv-slim
DEMO_MODEL := edge/zoo/compact-int8
DEMO_DRIVE := kitti-tracking:edge/samples/demo_drive
FLOAT_MODEL = $(OUT)/$(PRESET)-fp32
INT8_MODEL = $(OUT)/$(PRESET)-int8
RUN = $(OUT)/$(PRESET)-run
# The bundled weights know the bundled priors.
BEGINNING = $(addprefix --start ,$(START)) $(addprefix --backbone ,$(BACKBONE)) \
  $(if $(filter edge/zoo/%,$(START)),--priors edge/zoo/$(PRESET)-priors.npz)
SIMULATED = $(OUT)/simulated
NATIVE_SOURCES := $(wildcard runtime/native/*.cc runtime/native/*.h tests/runtime/native/*.cc)
# Results under the default OUT are these targets' own and may be replaced; a folder that you name is not.
OVERWRITE = $(if $(filter out,$(OUT)),--overwrite)
INSTALL = -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
# A model directory is written beside its place and renamed: it is whole, whatever ends the command after that.
.PRECIOUS: $(FLOAT_MODEL)/manifest.json $(INT8_MODEL)/manifest.json
.NOTPARALLEL:
.PHONY: help setup demo test lint export quantize accuracy stream bench train clean
MAKEFLAGS += --no-print-directory

## Targets
##   demo       the bundled INT8 model over the bundled simulated drive: AP, latency, video (nothing else needed)
##   test       lint and all tests; sets up what they need
##   lint       ruff, mypy, clang-format
##   setup      the full environment in .venv and the native kernel
##   export     CHECKPOINT -> OUT/PRESET-fp32, checked against torch
##   quantize   MODEL (OUT/PRESET-fp32) -> OUT/PRESET-int8, calibrated on KITTI's train frames or the bundled drive
##   accuracy   AP of the float and the INT8 model, or of MODEL, on SOURCE -> OUT/accuracy
##   stream     MODEL (the bundled one) over SOURCE -> OUT/stream: JSON lines and a video
##   bench      latency of MODEL, else of what is in OUT, else of the bundled one
##   train      simulate FRAMES frames, then train PRESET on them (and on KITTI's train frames) -> OUT/PRESET-run
##   clean      remove environments, builds and caches; OUT stays
## Variables
##   PRESET     compact (default), paper or mono
##   CHECKPOINT weights to export; default: the bundled ones, which only compact has.  PRIORS: theirs, if not beside
##   KITTI      folder of the KITTI object data set; its train frames calibrate, its val frames measure
##   SOURCE     frames to look at, a source URI; default: KITTI's val frames, else the bundled demo drive
##   MODEL      model directory, for accuracy and bench also several
##   OUT        folder of the results, default out
##   FRAMES, STEPS, DEVICE   of train: 2000 (a larger one adds to what is there), 10000, cpu
##   START, BACKBONE   of train: weights to begin from (default: the bundled ones, CC BY-NC-SA 3.0), or ImageNet's
##   PYTHON     the interpreter to make environments with
help:
	@echo "make TARGET [VARIABLE=value ...]"
	@sed -n 's/^## \{0,1\}//p' $(firstword $(MAKEFILE_LIST))

setup: $(VENV)/ready
	@$(VENV)/bin/python -m runtime.native.build

demo: $(SLIM)/ready
	@$(SLIM)/bin/python -m runtime.native.build
	@$(SLIM)/bin/edge accuracy $(DEMO_MODEL) --source "$(DEMO_DRIVE)"
	@$(SLIM)/bin/edge stream $(DEMO_MODEL) --source "$(DEMO_DRIVE)" --labels \
	  --json $(OUT)/demo/detections.jsonl --video $(OUT)/demo/demo.mp4 $(OVERWRITE)

test: lint
	$(VENV)/bin/python -m pytest

lint: setup
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy
	$(VENV)/bin/clang-format --dry-run --Werror $(NATIVE_SOURCES)

export: setup
	$(VENV)/bin/edge export --preset $(PRESET) --checkpoint $(CHECKPOINT) $(addprefix --priors ,$(PRIORS)) \
	  --out $(FLOAT_MODEL)

quantize: setup $(if $(MODEL),,$(FLOAT_MODEL)/manifest.json)
	$(VENV)/bin/edge quantize $(or $(MODEL),$(FLOAT_MODEL)) --out $(INT8_MODEL) \
	  $(if $(KITTI),--calibration "kitti-object:$(KITTI)?split=train")

accuracy: setup $(if $(MODEL),,$(FLOAT_MODEL)/manifest.json $(INT8_MODEL)/manifest.json)
	$(VENV)/bin/edge accuracy $(or $(MODEL),$(FLOAT_MODEL) $(INT8_MODEL)) --source "$(SOURCE)" \
	  --out $(OUT)/accuracy $(OVERWRITE)

stream: $(SLIM)/ready $(if $(filter oak:%,$(SOURCE)),$(SLIM)/ready-oak)
	@$(SLIM)/bin/python -m runtime.native.build
	$(SLIM)/bin/edge stream $(or $(MODEL),$(DEMO_MODEL)) --source "$(SOURCE)" \
	  --json $(OUT)/stream/detections.jsonl --video $(OUT)/stream/stream.mp4 $(OVERWRITE)

bench: $(SLIM)/ready
	@$(SLIM)/bin/python -m runtime.native.build
	$(SLIM)/bin/edge bench $(or $(MODEL),$(wildcard $(FLOAT_MODEL) $(INT8_MODEL)),$(DEMO_MODEL)) --source "$(SOURCE)"

train: setup
	$(VENV)/bin/edge simulate $(SIMULATED) --frames $(FRAMES)
	$(VENV)/bin/edge train --preset $(PRESET) --dataset "kitti-object:$(SIMULATED)?split=train" \
	  $(if $(KITTI),--dataset "kitti-object:$(KITTI)?split=train") \
	  --steps $(STEPS) --device $(DEVICE) --out $(RUN) $(if $(wildcard $(RUN)/checkpoint.pt),--resume,$(BEGINNING))

clean:
	rm -rf $(VENV) $(SLIM) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	rm -f runtime/native/*.so
	find calib edge export quantize runtime tests -name __pycache__ -type d -prune -exec rm -r {} +

# What the chain needs and nobody has made yet.
$(FLOAT_MODEL)/manifest.json: $(wildcard $(CHECKPOINT) $(PRIORS))
	@$(MAKE) export

$(INT8_MODEL)/manifest.json: $(FLOAT_MODEL)/manifest.json
	@$(MAKE) quantize

# Environments; the stamp is written last, so a broken-off installation is taken up again.
$(VENV)/ready: pyproject.toml setup.py constraints.txt
	@$(call environment,$(VENV))
	@echo "installing the full environment in $(VENV), torch included: some minutes"
	@$(VENV)/bin/python $(INSTALL) '.[all,dev]'
	@touch $@

$(SLIM)/ready: pyproject.toml setup.py constraints.txt
	@$(call environment,$(SLIM))
	@echo "installing the runtime alone in $(SLIM)"
	@$(SLIM)/bin/python $(INSTALL) .
	@touch $@

$(SLIM)/ready-oak: $(SLIM)/ready
	@$(SLIM)/bin/python $(INSTALL) '.[oak]'
	@touch $@

# environment(FOLDER): made with the first of PYTHON that is new enough and can make one.
environment = test -x $(1)/bin/pip || { \
	for python in $(PYTHON); do \
	  "$$python" -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && break; python=; \
	done; \
	test -n "$$python" || { echo "error: found no Python 3.11 with venv among $(PYTHON); expected one;" \
	  "install it (Debian: apt-get install python3 python3-venv) or name it: make PYTHON=FILE" >&2; exit 2; }; \
	"$$python" -m venv $(1); }
