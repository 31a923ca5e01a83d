"""What acts between pairs of beads: the box, lists of neighbours, geometry, laws, sums."""
