"""The systems and problems that come with nocl: one short file each, with system(**constants) and ocp(**options)."""
