from neuroslam.runs.ask import AskedMap

tour = AskedMap("tour")
for one in tour.ask("which landmarks are blue").found:
    print(one.name, one.position_m, one.words)
