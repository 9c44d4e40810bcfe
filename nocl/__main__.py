"""`python -m nocl` is `nocl`."""

from __future__ import annotations

import sys

from nocl.cli.commands import main

sys.exit(main())
