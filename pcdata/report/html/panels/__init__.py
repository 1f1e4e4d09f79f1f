"""The parts of the page on captures, each made of what was gathered alone."""
