"""GPU back end: Triton kernels, no compiler needed on the user's machine.

The modules follow the data as in the CPU back end: ``projection`` (parameters to packed splats), ``binning``
(splats to tiles), ``rasterise`` (tiles to pixels and back), ``gradients`` (back to the parameters), ``loss``,
``elementwise`` and ``densify``; ``pipeline`` runs them over reusable buffers, ``device_layout``
names what they hand on, ``support`` says whether all this can run here. ``docs/gpu.md`` counts operations
and bytes.

Every sum has a fixed order and no float is added atomically, so that a device gives the same bits each time.
Under ``TRITON_INTERPRET=1`` the kernels run on CPU tensors, which is how they are tested without a GPU.
"""
