"""The fleet's authority: keys, certificates, and the record of what was issued and revoked."""
