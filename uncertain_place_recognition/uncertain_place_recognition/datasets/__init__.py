"""Make runs of submaps from the simulator, from any recording, and from the benchmark's files."""
