"""Coloured point map and window-to-map association; see docs/architecture.md."""
