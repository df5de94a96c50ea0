"""Many flights in closed loop: flown on all cores, kept as they come, judged, summed up, drawn."""
