"""ROS messages to and from `dscp_core` types: the only place that knows message field names.

Conventions:

- ROS positions and velocities are in a z-up landing frame (REP 103; ``landing_site`` unless told
  otherwise). The core's first axis is up. `frames` holds the mapping between the two.
- SI units. Every number written into a message is converted by ``float()`` or ``int()``, because
  rclpy does not check field types unless ``ROS_PYTHON_CHECK_FIELDS=1`` is set.
- Whatever is refused raises `errors.RejectedInputError`, with a numbered `errors.InputCode`, the
  field, its value and the bound.
- No message that is built here holds a NaN or an infinity. A report leaves out the keys of numbers
  that are not known.
"""
