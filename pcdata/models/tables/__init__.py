"""The contracts, one table per family."""
