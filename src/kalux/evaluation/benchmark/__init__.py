"""The benchmark: many sequences by many methods, resumable, on one machine or on many, and its report.

`sequences` says what is run on, `jobs` runs one method on one sequence, `runners` runs many jobs, `store` keeps what is
done, `results` puts it together, `report` shows it.
"""
