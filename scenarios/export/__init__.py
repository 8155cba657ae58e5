"""Models for other tools: functions as C99 (:mod:`.cfunctions`), and FMUs (:mod:`.fmu`)."""
