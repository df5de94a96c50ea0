"""The demonstration: `python -m dscp_ros.demo --output DIR`."""
