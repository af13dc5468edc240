"""`python -m nolbo_ppl.cli VERB ...` is `nolbo VERB ...`."""

from nolbo_ppl.cli import main

main()
