"""Main program of a microcontroller: copy to the board as :main.py."""

from tipforce_loader import boot

boot.run()
