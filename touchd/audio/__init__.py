"""An audio interface as a DAQ: `card` is the seam of the library, `alsa` the library, `delay` finds the delay."""
