"""`tipforce ros2`: forces, contacts and diagnostics as ROS 2 messages, without ROS; `decode -o run.mcap` uses them."""
