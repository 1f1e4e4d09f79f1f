"""`pcdata view`: samples in a browser on this machine, each read when it is chosen."""
