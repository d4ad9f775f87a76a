"""What verbs share: how a daemon is asked, options, errors, pages and reports."""
