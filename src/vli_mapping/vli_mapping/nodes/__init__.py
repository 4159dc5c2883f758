"""The mapping stage as a node."""
