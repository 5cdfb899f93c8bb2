"""The bridge to ROS 2: messages of its robots as inputs of the team, and poses back to them.

`*_in.py` turn messages into inputs, `*_out.py` poses and statuses into messages: neither knows a
bus. `robot_bridge.py` and `command.py` connect them to both sides. A message that comes in is any
object with the fields of its type; one that goes out is a dictionary with the fields that differ
from their defaults.
"""
