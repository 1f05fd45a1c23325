"""Maps that are known in advance: their files, and how an estimate enters one."""
