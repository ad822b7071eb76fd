# Thin names over tools/dev.py, which also runs where there is no make: `py -3.11 tools/dev.py demo`.
# ARGS are words as of a shell, with quotes of their own where a word holds spaces: ARGS='-k "a or b"'.
PYTHON ?= $(shell command -v python3.11 || command -v python3)

.PHONY: demo demo-simulation test check extension docs bench env clean
demo demo-simulation test check extension docs bench env clean:
	"$(PYTHON)" tools/dev.py $@ $(ARGS)
