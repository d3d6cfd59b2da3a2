"""The Jacobian dI/dξ of a rendered image: one interface, several methods.

Each module has `prepare(view)`, once a view, and `jacobian(view, pixels, *, spp, seed, batches, prepared)`
for its pixels, tile by tile. They import Dr.Jit, which loads whatever LLVM it finds; so a usable one is
chosen here, before any of them is imported.
"""

from ..render import llvm

llvm.configure()
