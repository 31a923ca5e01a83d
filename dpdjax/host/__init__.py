"""The host side: running with repair and progress, files, pictures. Nothing imports it but the
command line."""
