"""Faster bodies of operations, one module per backend, loaded by :mod:`pcdata.contracts.dispatch` when first used."""
