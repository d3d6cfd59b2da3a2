"""Radiance fields: worlds whose image is known without noise, and so are its columns."""
