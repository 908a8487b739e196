"""A problem linearised about values of its unknowns, as normal equations with a structure that follows from index maps.

The numbers of the unknowns (`numbering`), the derivatives and their sums (`system`, `groups`), and the solution of the
normal equations (`normal`).
"""
