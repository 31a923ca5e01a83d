"""Runs and scans from a TOML file, whose names are those of Python."""
