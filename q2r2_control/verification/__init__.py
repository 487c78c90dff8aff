"""Whether the controller keeps its promises: checked at every tick, under hostile input and injected faults.

``contract`` is the one checker, for tests, soaks and live runs. ``adversary`` draws streams of targets,
``fault_injection`` uneven ticks, bad starts and failing solvers, and ``soak`` runs a controller through all of them.
``work_motions`` is the other side: what two arms do at work, for figures of how well they do it, and ``work_hands`` the
operator who makes them do it. ``assembly_tasks`` are the demo's, with real contacts: ``part_judges`` say whether they
succeeded, by what ``touch_watch`` sees.
"""
