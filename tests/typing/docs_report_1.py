from neuroslam.report import write_report

write_report("out", "page.html", pictures_mb=5, source=True)
