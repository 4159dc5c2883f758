"""``vli view``: results, bags and running scans in a browser, from a server that only this machine can reach."""
