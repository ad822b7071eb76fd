# Thin names over tools/dev.py, which also runs where there is no make: `py -3.11 tools/dev.py demo`.
PYTHON ?= $(shell command -v python3.11 || command -v python3)

.PHONY: demo demo-simulation test check extension docs bench env clean
demo demo-simulation test check extension docs bench env clean:
	"$(PYTHON)" tools/dev.py $@ $(ARGS)
