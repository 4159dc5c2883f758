"""What ``vli doctor`` looks at: a recording or a live sensor, before anybody scans with it.

Each check collects while data come in and then says what it found, in words: what is right, what will spoil a scan, what
prevents one.
"""
