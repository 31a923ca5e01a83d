"""What one reads off: observables of one state, and estimates over a trajectory."""
