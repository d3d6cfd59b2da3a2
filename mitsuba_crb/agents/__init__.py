"""Several agents: fusion, pose graphs, points, messages and their filter, choice of tiles, teams' files."""
