"""What is on disk: states, checkpoints, GSD files. Nothing imports it but the host side."""
