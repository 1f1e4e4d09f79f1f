"""The doors to the disk: files opened and written safely, and nothing half done stays."""
