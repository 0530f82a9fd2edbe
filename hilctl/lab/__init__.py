"""The laboratory around the daemon, which never imports it: models, studies, learning and pages.

comparison    hysteresis models on the same loops
identify      models from measured data
ilc           iterative learning control
model_export  models as functions in C and MATLAB
pages         parts of plots and pages
response      frequency and step responses, spectra, feedback design
run_report    plots and page of a recording
studies       experiments of several runs
"""
