"""A house with a heat pump, a day ahead: warm within bounds, and paid by an hourly price.

The usual two-node network of zone and walls (as in Bacher and Madsen, 2011, "Identifying suitable models for the heat
dynamics of buildings"); constants of our own choice. Weather and price are functions of the time of day.
"""

import casadi as ca
import numpy as np

import nocl

C_zone, C_wall = 1.5, 12.0  # kWh/K
U_inside, U_wall, U_window = 0.8, 0.15, 0.1  # kW/K
efficiency, P_max = 3.0, 3.0  # 1, kW of electricity
T_low, T_high, T_wish = 19.0, 24.0, 21.0  # degC

T, T_w, P = ca.SX.sym("T"), ca.SX.sym("T_w"), ca.SX.sym("P")
hour = 2 * np.pi * nocl.time() / 24
T_out = 3.0 + 5.0 * ca.sin(hour - 2.4)  # degC, warmest at three in the afternoon
sun = 0.8 * ca.exp(4 * (ca.cos(hour - np.pi) - 1))  # kW through the windows, at noon
price = 0.25 + 0.1 * ca.cos(2 * (hour - 2.1))  # EUR/kWh, with peaks at eight and eight

system = nocl.System(
    "heated_house", x=ca.vertcat(T, T_w), u=P,
    xdot=ca.vertcat((U_inside * (T_w - T) + U_window * (T_out - T) + sun + efficiency * P) / C_zone,
                    (U_inside * (T - T_w) + U_wall * (T_out - T_w)) / C_wall),
    lbu=[0], ubu=[P_max], lbx=[10, 5], ubx=[30, 30], units={"T": "degC", "T_w": "degC", "P": "kW"})

ocp = nocl.OCP(
    system, horizon=24.0, running=price * P + 0.02 * P**2 + 0.02 * (T - T_wish)**2, terminal=0.5 * (T_w - 19.0)**2,  # h
    initial_states=nocl.Uniform([19.5, 17.5], [22.5, 20.0]), state_bounds={"T": (T_low, T_high)})
