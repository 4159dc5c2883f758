"""The subcommands of ``vli calibrate``: each parses its arguments, calls the algorithm, writes file and report."""
