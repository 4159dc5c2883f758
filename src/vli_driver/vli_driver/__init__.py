"""From sensor or bag to triangulated stripes: sources, demultiplexer, stripe detector, triangulation."""
