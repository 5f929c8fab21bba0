"""Pure computations: arrays and parameters in, arrays out.

Nothing here reads a clock, a file or a socket, and nothing imports other parts of Pliant.
"""
