"""Logs, their maps and readings, as text; the good files that tests and programmes alter."""

LOG = """Tracker software 3.1
Length noise: 0,5
Setup;Point;X;Y;Z;Length;T;Day;Clock
S1;P1;0;0;0;1.000,5;20,1;27.10.2024;01:30:00
S1;P2;100;0;50;;20,1;27.10.2024;02:30:00
S2;P1;0;0;0;900,25;20,2;27.10.2024;02:30:00,5
S2;P2;100;0;50;880;20,2;27.10.2024;03:30:00
"""
MAP = """schema = "errormotion.raw.multilateration/1"
labels = {station = "Setup", target = "Point"}
values.displacement_noise = {key = "Length noise", unit = "um"}
values.vacuum_wavelength = "633 nm"
[format]
decimal = ","
thousands = "."
zone = "Europe/Berlin"
skip = 2
[columns]
displacement = {column = "Length", unit = "mm", scale = 1.0, offset = "2 mm"}
air_temperature = {column = "T", unit = "degC"}
reading_time = {column = ["Day", "Clock"], unit = "dd.mm.yyyy"}
target_nominal.x = {column = "X", unit = "mm"}
target_nominal.y = {column = 4, unit = "mm"}
target_nominal.z = {column = "Z", unit = "mm"}
"""
DRIFT = "t,X1,X2,Y1,Y2,Z,T\n" + "".join(f"2024-05-31T14:0{k}:00,1.{k},1.2,1.3,1.4,1.5,20.5\n" for k in range(6))
DRIFT_MAP = """schema = "errormotion.map/1"
bar_radius = "5 mm"
distance_noise = "0.3 um"
levels = ["10 mm", "50 mm"]
time = {column = "t", unit = "iso8601"}
temperatures.frame = {column = "T", unit = "degC"}
""" + "".join(
    f'[channels.{name}]\ncolumn = "{name}"\nunit = "mm"\norigin = ["0 mm", "0 mm", "10 mm"]\ndirection = [1, 0, 0]\n'
    for name in ("X1", "X2", "Y1", "Y2", "Z")
)
READINGS = """# schema = errormotion.raw.beam_direction/1
# nominal_direction = 0.342 0 0.940
# distance_noise = 0.1 um
# machine = "C-frame"
plane,distance [mm],stage_x [mm],stage_y [mm],stage_z [mm]
1,-2.004,100.000,50.000,20.000
1,-1.508,101.000,50.000,20.000
2,-1.1,100.5,50.1,20.1
2,,100.5,50.1,20.1

plane,nominal_normal_x [1],nominal_normal_y [1],nominal_normal_z [1]
1,0,0,1
2,0,1,0
"""
