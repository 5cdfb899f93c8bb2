"""The team's own certificate authority: who gets a certificate, and where its keys lie."""
