"""`python -m atlantis_exp [VERB] overrides`: no verb means train."""

from atlantis_exp.commands import main

if __name__ == "__main__":
    main()
