"""`python -m nolbo_ppl VERB ...` is `nolbo VERB ...`."""

from nolbo_ppl.cli import main

main()
