"""The front end as a node."""
