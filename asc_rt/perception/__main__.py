"""`python -m asc_rt.perception CELL`."""

from __future__ import annotations

from asc_rt import realtime

realtime.one_blas_thread()  # before numpy is imported

import sys  # noqa: E402

from asc_rt.perception.process import main  # noqa: E402

sys.exit(main())
