"""Pure computations: arrays and parameters in, arrays out.

Nothing here reads a clock, a file or a socket, and of Pliant only the compiler is imported.
"""
