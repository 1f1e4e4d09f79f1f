"""Messages of robots' recordings: the files they lie in, and what they mean."""
