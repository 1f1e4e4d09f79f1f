# The commands people type. `make install` works in the environment that is active.
.PHONY: install test lint types demo

install:
	pip install -c constraints.txt -e ".[dev]"

test:
	python -m pytest

lint:
	ruff check . && ruff format --check .

types:
	mypy

demo:
	pcdata demo
