"""Ways to measure the Jacobian dI/dξ of a rendered image: one `Method` protocol, several methods.

They import Dr.Jit, which loads whatever LLVM it finds; so a usable one is chosen here, before any of them is
imported.
"""

from ..render import llvm

llvm.configure()
