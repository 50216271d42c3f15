"""Image formation: colour, motion blur, rolling shutter and defocus, and the estimation of their parameters.

A frame image is compared with the render *as its camera saw it*:

    sharp render -> colour affine -> linear light -> exposure along the motion, through the lens -> sRGB

and the gradient of the comparison goes back through the exact transpose.
"""
