"""Equal parts of a step that is cut until it is solved."""

from __future__ import annotations

#: Parts that are solved until the next ones are twice as long.
_WELL = 4


class Parts:
    """What is left of a step, in equal parts: one, more of them where it fails, fewer again later.

    Args:
        most: How often it may be cut.

    Attributes:
        left: How many are left.
    """

    def __init__(self, most: int) -> None:
        self.left, self._cuts, self._most = 1, 0, most
        self._solved, self._enough, self._grown = 0, _WELL, False

    def cut(self) -> bool:
        """Cut what is left after a failure; False if it was cut as often as it may be."""
        if self._cuts == self._most:
            return False
        if self._grown:
            self._enough *= 2
        self._cuts, self._solved, self._grown = self._cuts + 1, 0, False
        # An odd number: halves of halves would end where one of them has failed.
        self.left = 2 * self.left + 1
        return True

    def take(self) -> bool:
        """One is solved; whether those that are left have another length from here."""
        self.left, self._solved = self.left - 1, self._solved + 1
        if not self._cuts or self.left < 2 or self._solved < self._enough:
            return False
        self._cuts, self._solved, self._grown = self._cuts - 1, 0, True
        self.left = (self.left + 1) // 2
        return True
