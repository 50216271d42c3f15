"""What the splatting core costs and how far it is from the truth: every time stands beside its error.

``scenes`` makes the inputs, ``timing`` and ``probe`` take the times, ``iteration`` is what is timed,
``oracle`` gives the errors, ``torch_tiles`` is what it is compared with,
``peaks``, ``work`` and ``roofline`` say what the machine could do, ``memory`` asks a process of its own,
``scaling`` fits lines. ``benchmark`` runs a ``plan``; ``markdown`` and ``pictures`` show its ``results``.
``device`` runs a plan for a GPU beside ``gsplat_cuda``, ``device_markdown`` shows what it found.
Nothing here is needed to make a scene.
"""
