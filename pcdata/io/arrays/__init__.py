"""Arrays by name from files of other programs, read without believing what they say."""
