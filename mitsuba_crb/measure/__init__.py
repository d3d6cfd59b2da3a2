"""From something to measure to its Jacobian, its information, its bound, and to checks of them."""
