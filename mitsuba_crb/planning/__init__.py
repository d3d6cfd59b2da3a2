"""Bounds of thousands of views, and what follows from them: where to look, and how to go."""
