"""The derivative of an image in its camera's pose, the Fisher information it gives, and what that sees."""
