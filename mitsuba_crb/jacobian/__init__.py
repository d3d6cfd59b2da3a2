"""The Jacobian dI/dξ of a rendered image: one interface, several methods."""
