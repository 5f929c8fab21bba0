"""ROS 2 without ROS: the keys and attachments of rmw_zenoh, and messages by rosbags' serialiser."""
