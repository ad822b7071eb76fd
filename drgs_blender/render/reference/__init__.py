"""The renderer in plain torch: slow, exact, differentiable, any device and dtype.

It is written from the physics, apart from the Numba kernels, so that the agreement of the two means something: the
oracle of the tests, and the differentiable base of reconstruction. Nothing of the fast path imports it.
"""
