"""The driver's nodes: sources, and demultiplexer with stripe detector."""
