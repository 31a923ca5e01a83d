"""Inverse problems: which parameter gives the number that is wanted."""
