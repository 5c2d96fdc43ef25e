"""Plug-ins for robots: ROS 2 and MCAP, fingertips of a MuJoCo model, observations for learning."""
