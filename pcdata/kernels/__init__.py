"""Faster bodies of operations, one module per backend; loaded by :mod:`pcdata.dispatch` when first asked for."""
