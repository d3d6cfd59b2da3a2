"""The Cramér–Rao bound and its kin: inverse, priors, coordinates, displacements, optimality, consistency."""
