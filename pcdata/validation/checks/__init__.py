"""The checks of a capture, one file per question."""
