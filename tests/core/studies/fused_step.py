"""The linear step of one frictionless tip, fused by hand into one function without a choice.

What :mod:`avatar_core.contact.kernels` compiles for a scene without effects must cost no more than
this, and give the same: the yardstick of ``avatar bench effects``. It shares the arrays of a
contact model and nothing of its code.
"""

from __future__ import annotations

import numpy as np
from numba import njit

OK, INVALID_POSE, OUT_OF_RANGE = 0, 4, 7
OUTSIDE, ENTERED, BARRED = range(3)
BLOCK, LEAST_WEIGHT = 192, 0.02
HASH = 2654435761


@njit(
    fastmath={"reassoc", "contract", "arcp", "nsz", "afn"},  # all but nnan and ninf
    error_model="numpy",
    _nrt=False,
)
def fused_step(model, space, state, out, tips):  # type: ignore[no-untyped-def]
    """One period of one tool: status; force, contact and cloud into ``out``."""
    out.force[0] = 0.0
    out.torque[0] = 0.0
    out.n_contacts[0] = 0
    out.status[0] = OK
    x, y, z = tips[0, 0], tips[0, 1], tips[0, 2]
    before, seen = state.passage[0], state.seen[0]
    farthest = 50e-3 if state.active[0] else 5e-3
    way = (x - seen[0]) ** 2 + (y - seen[1]) ** 2 + (z - seen[2]) ** 2
    continuous = way < farthest * farthest
    state.active[0] = False
    state.force[0] = 0.0
    touches = False
    status = OK
    if not (abs(x) < np.inf and abs(y) < np.inf and abs(z) < np.inf):
        status = INVALID_POSE
    else:
        state.passage[0] = OUTSIDE
        # --- where the tip is on the grid, and its B-splines -----------------------------------
        scale = 1.0 / model.spacing[0]
        shape = model.distance.shape
        gx = (x - model.origin[0]) * scale
        gy = (y - model.origin[1]) * scale
        gz = (z - model.origin[2]) * scale
        fx, fy, fz = np.floor(gx + 0.5), np.floor(gy + 0.5), np.floor(gz + 0.5)
        if 1.0 <= fx < shape[0] - 1.0 and 1.0 <= fy < shape[1] - 1.0 and 1.0 <= fz < shape[2] - 1.0:
            i0, j0, k0 = int(fx) - 1, int(fy) - 1, int(fz) - 1
            tx, ty, tz = gx - fx, gy - fy, gz - fz
            wx = (0.5 * (0.5 - tx) ** 2, 0.75 - tx * tx, 0.5 * (0.5 + tx) ** 2)
            wy = (0.5 * (0.5 - ty) ** 2, 0.75 - ty * ty, 0.5 * (0.5 + ty) ** 2)
            wz = (0.5 * (0.5 - tz) ** 2, 0.75 - tz * tz, 0.5 * (0.5 + tz) ** 2)
            sx = ((tx - 0.5) * scale, -2.0 * tx * scale, (tx + 0.5) * scale)
            sy = ((ty - 0.5) * scale, -2.0 * ty * scale, (ty + 0.5) * scale)
            sz = ((tz - 0.5) * scale, -2.0 * tz * scale, (tz + 0.5) * scale)
            # --- distance, its gradient, access, compliance ------------------------------------
            phi = p0 = p1 = p2 = 0.0
            for i in range(3):
                plane = along_y = along_z = 0.0
                for j in range(3):
                    v0 = model.distance[i0 + i, j0 + j, k0]
                    v1 = model.distance[i0 + i, j0 + j, k0 + 1]
                    v2 = model.distance[i0 + i, j0 + j, k0 + 2]
                    line = wz[0] * v0 + wz[1] * v1 + wz[2] * v2
                    plane += wy[j] * line
                    along_y += sy[j] * line
                    along_z += wy[j] * (sz[0] * v0 + sz[1] * v1 + sz[2] * v2)
                phi += wx[i] * plane
                p0 += sx[i] * plane
                p1 += wx[i] * along_y
                p2 += wx[i] * along_z
            chi = c0 = c1 = c2 = 0.0
            for i in range(3):
                plane = along_y = along_z = 0.0
                for j in range(3):
                    v0 = model.access[i0 + i, j0 + j, k0]
                    v1 = model.access[i0 + i, j0 + j, k0 + 1]
                    v2 = model.access[i0 + i, j0 + j, k0 + 2]
                    line = wz[0] * v0 + wz[1] * v1 + wz[2] * v2
                    plane += wy[j] * line
                    along_y += sy[j] * line
                    along_z += wy[j] * (sz[0] * v0 + sz[1] * v1 + sz[2] * v2)
                chi += wx[i] * plane
                c0 += sx[i] * plane
                c1 += wx[i] * along_y
                c2 += wx[i] * along_z
            gamma = g0 = g1 = g2 = 0.0
            for i in range(3):
                plane = along_y = along_z = 0.0
                for j in range(3):
                    v0 = model.self_compliance[i0 + i, j0 + j, k0]
                    v1 = model.self_compliance[i0 + i, j0 + j, k0 + 1]
                    v2 = model.self_compliance[i0 + i, j0 + j, k0 + 2]
                    line = wz[0] * v0 + wz[1] * v1 + wz[2] * v2
                    plane += wy[j] * line
                    along_y += sy[j] * line
                    along_z += wy[j] * (sz[0] * v0 + sz[1] * v1 + sz[2] * v2)
                gamma += wx[i] * plane
                g0 += sx[i] * plane
                g1 += wx[i] * along_y
                g2 += wx[i] * along_z
            gap = phi - model.tip_offset[0]
            if gap < 0.0:
                deepest = 25e-3 if before == ENTERED and continuous else 5e-3
                if chi < 1e-2:
                    status = OUT_OF_RANGE
                elif before == BARRED or phi < -deepest:
                    state.passage[0] = BARRED
                    status = OUT_OF_RANGE
                else:
                    state.active[0] = touches = True
                    state.passage[0] = ENTERED
                    seen[0], seen[1], seen[2] = x, y, z
                    if chi < 0.99:
                        status = OUT_OF_RANGE
    out.status[0] = status
    field = state.field
    if not touches:
        field[:] = np.float32(0.0)
    else:
        steepness = max(np.sqrt(p0 * p0 + p1 * p1 + p2 * p2), 1e-3)
        n0, n1, n2 = p0 / steepness, p1 / steepness, p2 / steepness
        # --- load positions that carry the tip ---------------------------------------------------
        nodes, weight, count = state.nodes[0], state.weight[0], 0
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    row = model.row[i0 + i, j0 + j, k0 + k]
                    if row < 0:
                        continue
                    b = wx[i] * wy[j] * wz[k]
                    for e in range(model.carrier.shape[1]):
                        carrier_weight = model.carrier_weight[row, e]
                        if carrier_weight == 0.0:
                            continue
                        carrier = model.carrier[row, e]
                        q = state.local[carrier]
                        if q < 0:
                            if count == nodes.shape[0]:
                                continue
                            q = count
                            state.local[carrier], nodes[q] = q, carrier
                            weight[q, 0] = 0.0
                            count += 1
                        weight[q, 0] += b * carrier_weight
        for q in range(count):
            state.local[nodes[q]] = -1
        # --- modes, near column, compliance of the interpolation ------------------------------
        mode = state.mode[0]
        mode[:] = np.float32(0.0)
        for i in range(count):
            w, load = weight[i, 0], model.load[nodes[i]]
            w0, w1, w2 = np.float32(w * n0), np.float32(w * n1), np.float32(w * n2)
            for k in range(mode.shape[0]):
                mode[k] += w0 * load[0, k] + w1 * load[1, k] + w2 * load[2, k]
        near = 0.0
        for i in range(count):
            j = nodes[i]
            start = model.contact_start[j]
            mask = model.contact_start[j + 1] - start - 1
            for q in range(i + 1):
                k = (np.int64(nodes[q]) * HASH >> 16) & mask
                found = model.contact_slot[start + k, 0]
                while found >= 0 and found != nodes[q]:
                    k = (k + 1) & mask
                    found = model.contact_slot[start + k, 0]
                if found < 0:
                    continue
                b = model.contact_block[model.contact_slot[start + k, 1]]
                v0 = b[0, 0] * n0 + b[0, 1] * n1 + b[0, 2] * n2
                v1 = b[1, 0] * n0 + b[1, 1] * n1 + b[1, 2] * n2
                v2 = b[2, 0] * n0 + b[2, 1] * n1 + b[2, 2] * n2
                both = weight[i, 0] * weight[q, 0] * (1.0 if q == i else 2.0)
                near += both * (n0 * v0 + n1 * v1 + n2 * v2)
        far = np.float32(0.0)
        for k in range(mode.shape[0]):
            far += mode[k] * mode[k]
        a = np.sqrt(gamma / (far + near))
        # --- force ----------------------------------------------------------------------------
        access = min(chi, 1.0)
        fade = model.softness[0] * (1.0 / access - 1.0)
        force = max(0.0, -gap / (gamma + fade))
        state.force[0] = force
        f0 = force * (p0 + 0.5 * force * g0)
        f1 = force * (p1 + 0.5 * force * g1)
        f2 = force * (p2 + 0.5 * force * g2)
        if access < 1.0:
            fading = 0.5 * force * force * model.softness[0] / (access * access)
            f0, f1, f2 = f0 - fading * c0, f1 - fading * c1, f2 - fading * c2
        out.n_contacts[0] = 1
        out.contact_tool[0] = 0
        out.contact_penetration[0] = fade * force
        out.force[0, 0], out.force[0, 1], out.force[0, 2] = f0, f1, f2
        out.contact_force[0, 0], out.contact_force[0, 1], out.contact_force[0, 2] = f0, f1, f2
        out.contact_normal[0, 0], out.contact_normal[0, 1], out.contact_normal[0, 2] = n0, n1, n2
        r = model.tip_offset[0]
        out.contact_position[0, 0] = x - r * n0
        out.contact_position[0, 1] = y - r * n1
        out.contact_position[0, 2] = z - r * n2
        # --- regions of the load positions -----------------------------------------------------
        amplitude, start = state.amplitude, model.region_start
        region_weight, n_touched, kept = state.region_weight, 0, 0.0
        for i in range(state.n_touched[0]):
            state.is_touched[state.touched[i]] = False
        for i in range(count):
            region_weight[model.region[nodes[i]]] = 0.0
        for i in range(count):
            region_weight[model.region[nodes[i]]] += weight[i, 0]
        for i in range(count):
            whole = region_weight[model.region[nodes[i]]]
            part = max(whole - LEAST_WEIGHT, 0.0) if whole > 0.0 else min(whole + LEAST_WEIGHT, 0.0)
            if whole != 0.0:
                kept += weight[i, 0] * part / whole
        for i in range(count):
            j = nodes[i]
            r = model.region[j]
            whole = region_weight[r]
            part = max(whole - LEAST_WEIGHT, 0.0) if whole > 0.0 else min(whole + LEAST_WEIGHT, 0.0)
            if whole == 0.0 or weight[i, 0] * part == 0.0:
                continue
            if not state.is_touched[r]:
                state.is_touched[r] = True
                state.touched[n_touched] = r
                n_touched += 1
                amplitude[start[r] : start[r + 1]] = np.float32(0.0)
            part = -weight[i, 0] * part / whole * force * a / kept
            w0, w1, w2 = np.float32(part * n0), np.float32(part * n1), np.float32(part * n2)
            load, first = model.regional_load[j], start[r]
            for k in range(start[r + 1] - first):
                amplitude[first + k] += load[0, k] * w0 + load[1, k] * w1 + load[2, k] * w2
        state.n_touched[0] = n_touched
        # --- modes -----------------------------------------------------------------------------
        core, shown = model.core, state.shown[0]
        for block in range(model.block_start.shape[1] - 1):
            u = field[block * BLOCK : (block + 1) * BLOCK]
            for i in range(BLOCK):
                u[i] = np.float32(0.0)
            for q in range(n_touched):
                r = state.touched[q]
                own = amplitude[start[r] : start[r + 1]]
                first, end = model.block_start[1 + r, block], model.block_start[1 + r, block + 1]
                while end > first and model.level[end - 1] > shown:
                    end -= 1
                whole_fours = end - (end - first) % 4
                for k in range(first, whole_fours, 4):
                    a0 = a1 = a2 = a3 = np.float32(0.0)
                    for m in range(own.shape[0]):
                        a0 += core[k, m] * own[m]
                        a1 += core[k + 1, m] * own[m]
                        a2 += core[k + 2, m] * own[m]
                        a3 += core[k + 3, m] * own[m]
                    s0, s1, s2, s3 = space[k], space[k + 1], space[k + 2], space[k + 3]
                    for i in range(BLOCK):
                        u[i] += s0[i] * a0 + s1[i] * a1 + s2[i] * a2 + s3[i] * a3
                for k in range(whole_fours, end):
                    a0 = np.float32(0.0)
                    for m in range(own.shape[0]):
                        a0 += core[k, m] * own[m]
                    s0 = space[k]
                    for i in range(BLOCK):
                        u[i] += s0[i] * a0
    # --- cloud ---------------------------------------------------------------------------------
    rest, cloud, place = model.rest, out.cloud, model.place
    for v in range(place.shape[0]):
        ux, uy, uz = field[3 * place[v]], field[3 * place[v] + 1], field[3 * place[v] + 2]
        cloud[v, 0], cloud[v, 1], cloud[v, 2] = rest[v, 0] + ux, rest[v, 1] + uy, rest[v, 2] + uz
        cloud[v, 3], cloud[v, 4], cloud[v, 5] = ux, uy, uz
    return status
