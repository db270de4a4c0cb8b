"""`python -m icheat_usd` is `icheat`."""

from icheat_usd.cli import main

raise SystemExit(main())
