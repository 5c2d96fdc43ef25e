# Each target installs what it needs (tools/bootstrap.sh: .venv, and for `test` the system packages).
SHELL := /bin/bash
PYTHON := .venv/bin/python

.DEFAULT_GOAL := help
.PHONY: help demo test oldest newest wheel report docs long generate lint lint-style lint-types lint-imports clean

help: ## list the targets
	@sed -n 's/^\([a-z]*\):.*## /  make \1\t/p' $(MAKEFILE_LIST)

demo: bootstrap-demo ## run the demo; needs no hardware
	@.venv/bin/tipforce demo

# tests/vcan needs a kernel with vcan: this one, or else User-mode Linux, which has one processor. So the other tests run
# beside it, and give way to it, because a node in a process of its own has to respond in time. It is shown last.
test: lint ## check style, types and imports, run all tests, also on a real vcan
	@mkdir -p build; \
	.venv/bin/tipforce vcan -- $(PYTHON) -m pytest tests/vcan >build/vcan.txt 2>&1 & vcan=$$!; \
	trap 'kill $$vcan 2>/dev/null' EXIT; \
	nice -n 10 $(PYTHON) -m pytest -n auto --dist=worksteal; others=$$?; \
	wait $$vcan; vcan_ended=$$?; cat build/vcan.txt; exit $$((others | vcan_ended))

oldest: ## run the tests with the oldest versions that pyproject.toml allows, in a separate venv
	@tests/versions.sh oldest

newest: ## the same with the newest versions
	@tests/versions.sh newest

wheel: ## build the wheel, install it in an empty environment, and use it from an empty directory
	@tests/wheel.sh

lint: bootstrap-test ## check style, types and imports
	@$(MAKE) --no-print-directory -j2 --output-sync=target lint-style lint-types lint-imports

lint-style:
	.venv/bin/ruff check
	.venv/bin/ruff format --check

lint-types:
	.venv/bin/mypy

lint-imports:
	.venv/bin/lint-imports --no-logo

report: bootstrap-report ## run the extreme cases, write build/report/index.html: error against run time; ten minutes
	PYTHONPATH=tests $(PYTHON) -m stability.case
	.venv/bin/tipforce report -o build/report

docs: bootstrap-docs ## build the documentation site: build/site/index.html
	NO_MKDOCS_2_WARNING=1 REPOSITORY_URL="$${REPOSITORY_URL-$$(git remote get-url origin 2>/dev/null | grep ^https:)}" \
		$(PYTHON) -m mkdocs build --strict

long: bootstrap-test ## run every long check at full size, and write the reports; about two hours
	tests/wheel.sh
	tests/ros2.sh
	$(PYTHON) -m bench.fuzz --frames 10000000 --jobs 2
	$(PYTHON) -m bench.fuzz_sdo --conversations 1000000
	$(PYTHON) -m bench.device
	$(PYTHON) -m bench.fuzz --eds 500000
	$(PYTHON) -m bench.firmware
	$(PYTHON) -m bench.export_c
	$(PYTHON) -m bench.decode
	$(PYTHON) -m bench.decode --check
	$(PYTHON) -m bench.scale
	$(PYTHON) -m bench.exponents
	$(PYTHON) tests/test_costs.py --instructions
	TIPFORCE_KILLS=100 TIPFORCE_CLUSTER=4 $(PYTHON) -m pytest -q tests/tools/decode/test_dataset.py tests/running \
		tests/microcontroller/test_programs.py -k "kill or power_cuts" -o faulthandler_timeout=0
	TIPFORCE_ALL_CASES=1 $(PYTHON) -m pytest -q tests/micropython/test_replay.py -k conformance
	TIPFORCE_ALL_WRITES=1 $(PYTHON) -m pytest -q tests/host/hand/test_another_master.py -s -o faulthandler_timeout=0
	TIPFORCE_DAYS=30 $(PYTHON) -m pytest -q tests/tools/decode/test_dataset_readers.py
	$(PYTHON) -m bench.live
	$(PYTHON) -m bench.hand
	TIPFORCE_SEQUENCES=10000 $(PYTHON) -m pytest -q tests/host/hand/test_rows.py -k random_sequences -o faulthandler_timeout=0
	$(PYTHON) -m bench.view
	$(PYTHON) -m bench.twin
	$(PYTHON) -m bench.soak
	$(PYTHON) -m bench.endurance
	$(PYTHON) -m bench.calibration
	$(PYTHON) -m bench.coverage
	$(PYTHON) -m bench.honesty
	$(PYTHON) -m bench.fault_detection
	$(PYTHON) -m bench.fem
	.venv/bin/tipforce report -o build/report

generate: bootstrap-test ## write the committed files generated from the object dictionary and the command line
	@$(PYTHON) -m tipforce.dictionary.generate
	@$(PYTHON) -m bench.documents generated

clean: ## remove .venv, caches and build results
	rm -rf .venv build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find node -name '_core.*' ! -name '*.c' -delete
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

bootstrap-%:
	@tools/bootstrap.sh $*
