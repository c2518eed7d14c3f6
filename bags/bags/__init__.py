"""Read drives of many formats, write them as rosbag2 mcap, and replay them."""
