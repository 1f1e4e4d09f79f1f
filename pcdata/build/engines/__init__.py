"""Who works on the shards of a build: this process, a pool of processes, or a Ray cluster."""
