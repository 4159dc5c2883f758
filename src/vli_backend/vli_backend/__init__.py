"""Initialisation and fixed-lag smoother; see docs/architecture.md."""
