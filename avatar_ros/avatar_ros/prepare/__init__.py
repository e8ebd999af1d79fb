"""The way of a vademecum into the loop: another process verifies the file, applies scene,
material and budget, compiles, and hands the arrays over through shared memory, so that the loop
never waits.
"""
