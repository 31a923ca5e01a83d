"""Bonds, angles and dihedrals: which beads, their coordinates, and what acts along them."""
