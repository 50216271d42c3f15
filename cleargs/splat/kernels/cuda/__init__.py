"""GPU back end in Triton, which needs a C compiler on the user's machine, and no CUDA toolkit.

The modules follow the data, as in the CPU back end: ``projection`` (parameters to packed splats), ``binning``
(splats to tiles), ``rasterise`` (tiles to pixels and back), ``gradients`` (back to the parameters), ``loss``,
``elementwise``, ``densify`` and ``frame_warp``. ``pipeline`` runs them over reusable buffers.
``device_layout`` describes the data between kernels. ``support`` tests if the kernels can run on a device,
and ``self_test`` compares them with the CPU's. ``docs/gpu.md`` counts operations and bytes.

Every sum of floats has a fixed order, and no float is added atomically, so that one device gives the same
bits each time. Under ``TRITON_INTERPRET=1`` the kernels run on CPU tensors: tests use that.
"""
