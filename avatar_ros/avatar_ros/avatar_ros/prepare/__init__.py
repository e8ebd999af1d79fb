"""The path of a vademecum to the contact loop.

A separate process verifies the file, applies scene and material, compiles the step and puts the
model's arrays into shared memory. The loop's process only maps them, so the loop never waits.

Read in this order: requests, protocol, supplier (in the node), worker (the process), and what the
worker uses: model_spec, bands, shared_arrays.
"""
