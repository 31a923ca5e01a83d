"""Scans: one experiment at many points, as one table."""
