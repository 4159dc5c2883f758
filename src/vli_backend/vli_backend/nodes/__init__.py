"""The back end as a node."""
