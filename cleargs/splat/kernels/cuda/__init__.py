"""GPU back end in Triton, which needs a C compiler on the user's machine, and no CUDA toolkit.

The modules are those of the CPU back end, and ``densify``. ``device_layout`` describes the data between
kernels. ``support`` tests if they can run on a device, and ``self_test`` compares them with the CPU's.
``docs/gpu.md`` counts operations and bytes.

Every sum of floats has a fixed order, and no float is added atomically, so that one device gives the same
bits each time. Under ``TRITON_INTERPRET=1`` the kernels run on CPU tensors: tests use that.
"""
