"""``vli record``: topics to a rosbag2 directory, as they come and without decoding them."""
