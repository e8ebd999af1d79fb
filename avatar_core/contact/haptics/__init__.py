"""What stands between the contact model and a hand. Forces and poses come in; forces within the
device's limits go out, with soft engagement after faults, passivity observed and controlled in
the time domain, and fewer modes shown while the machine is busy.
"""
