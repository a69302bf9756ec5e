"""Which finger is which: the assignment with the least total cost."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf


def assign(cost: Sequence[Sequence[float]]) -> list[int]:
    """Return the column of each row in the assignment of least total cost, every column used at most once.

    Shortest augmenting paths with potentials, O(rows^2 columns) (Jonker and Volgenant, Computing 38:325,
    1987). In plain Python: the daemon does without scipy, and a plate has few fingers.

    Parameters
    ----------
    cost : of shape (rows, columns), rows <= columns
        Finite numbers.
    """
    rows, columns = len(cost), len(cost[0]) if cost else 0
    if rows > columns:
        raise ValueError(f"{rows} rows cannot be assigned to {columns} columns")
    row_price = [0.0] * (rows + 1)
    column_price = [0.0] * (columns + 1)
    # Column 0 and row 0 are a sentinel: the row that is looking for a column sits in column 0.
    holder = [0] * (columns + 1)
    for row in range(1, rows + 1):
        holder[0] = row
        column = 0
        reach = [inf] * (columns + 1)
        came_from = [0] * (columns + 1)
        done = [False] * (columns + 1)
        while holder[column]:
            done[column] = True
            i, step, nearest = holder[column], inf, 0
            for j in range(1, columns + 1):
                if done[j]:
                    continue
                slack = cost[i - 1][j - 1] - row_price[i] - column_price[j]
                if slack < reach[j]:
                    reach[j], came_from[j] = slack, column
                if reach[j] < step:
                    step, nearest = reach[j], j
            for j in range(columns + 1):
                if done[j]:
                    row_price[holder[j]] += step
                    column_price[j] -= step
                else:
                    reach[j] -= step
            column = nearest
        while column:
            holder[column] = holder[came_from[column]]
            column = came_from[column]
    result = [0] * rows
    for j in range(1, columns + 1):
        if holder[j]:
            result[holder[j] - 1] = j - 1
    return result
