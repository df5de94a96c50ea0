"""ROS messages to and from `dscp_core` types: the only place that knows message field names.

Conventions:

- Names, order, axes and frame of a problem's state in messages are what the problem says of them
  (`dscp_core.problem.messages`); `layout` holds the mapping.
- SI units. Every number written into a message is converted by ``float()`` or ``int()``, because
  rclpy does not check field types unless ``ROS_PYTHON_CHECK_FIELDS=1`` is set.
- Whatever is refused raises `errors.RejectedInputError`, with a numbered `errors.InputCode`, the
  field, its value and the bound.
- No message that is built here holds a NaN or an infinity. A report leaves out the keys of numbers
  that are not known.
"""
