"""Reading of RS-274 (ISO 6983) code: words, modal state, offsets, and the resulting moves."""
