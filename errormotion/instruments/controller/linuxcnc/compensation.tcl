# Compensation by errormotion, in the servo thread of LinuxCNC: limit, slew limit, hold, watchdog. Must be the last HALFILE.
#
#   [HAL]          TWOPASS = ON                so that other files can load the same components
#                  HALFILE = compensation.tcl
#   [ERRORMOTION]  ROUTE = external            or feedback, see below
#                  LIMIT = 0.05                largest offset of an axis, machine units
#                  SLEW = 0.001                largest rate of change of an axis, machine units/s
#                  WATCHDOG = 5                time without a heartbeat after which the offset ramps to zero, s
#                  HOLD = motion.digital-out-00   optional: while this pin is true, the offset does not change
#
# request (set by the bridge) -> source: zero unless alive and ready -> limit: LIMIT and SLEW -> offset
#
# external: the offset is an external offset of LinuxCNC (axis.L.eoffset). Each axis needs
#           [AXIS_L] OFFSET_AV_RATIO = SLEW / MAX_VELOCITY, rounded down: its planner then also observes the slew limit.
# feedback: the offset is added to joint.N.motor-pos-cmd and subtracted from joint.N.motor-pos-fb. The signals of these
#           pins are interrupted here; only for machines whose joints are their axes (trivkins).

source [file join $::env(HALLIB_DIR) hal_procs_lib.tcl]

proc errormotion_setting {name} {
    if {![info exists ::ERRORMOTION($name)]} {
        return -code error "compensation.tcl: expected \[ERRORMOTION\] $name in the INI file; found none"
    }
    set value $::ERRORMOTION($name)
    if {$name != "ROUTE" && (![string is double -strict $value] || $value <= 0)} {
        return -code error "compensation.tcl: expected \[ERRORMOTION\] $name above 0; found $value"
    }
    return $value
}

proc errormotion_names {parts} {
    set found {}
    foreach part $parts { foreach letter {x y z} { lappend found errormotion-$part-$letter } }
    return $found
}

# Connect a pin that other files may have connected already.
proc errormotion_join_pin {pin args} {
    if {![connection_info of $pin]} { return -code error "compensation.tcl: expected a pin $pin; found none" }
    set signal [expr {$of(signame) == "" ? "errormotion-$pin" : $of(signame)}]
    net $signal $pin
    foreach target $args { net $signal => $target }
}

# Disconnect a pin of motion from its signal, and connect it to another pin; return the signal.
proc errormotion_cut {pin other} {
    if {![connection_info of $pin] || $of(signame) == ""} {
        return -code error "compensation.tcl: expected a signal at $pin; found none. Is this the last HALFILE?"
    }
    unlinkp $pin
    net errormotion-$pin $pin $other
    return $of(signame)
}

proc errormotion_components {route} {
    loadrt oneshot names=errormotion-alive,errormotion-thread
    loadrt select8 names=errormotion-motion
    loadrt flipflop names=errormotion-asked
    loadrt not names=errormotion-off
    loadrt and2 names=errormotion-on,errormotion-fresh,errormotion-ready,errormotion-held
    loadrt or2 names=errormotion-sign,errormotion-hold-1,errormotion-hold-2
    loadrt mux2 names=[join [concat errormotion-slew [errormotion_names source]] ,]
    loadrt limit2 names=[join [errormotion_names limit] ,]
    if {$route == "external"} {
        loadrt scale names=[join [errormotion_names scale] ,]
        loadrt conv_float_s32 names=[join [errormotion_names counts] ,]
    } else {
        loadrt sum2 names=[join [concat [errormotion_joints command] [errormotion_joints feedback]] ,]
    }
}

# request -> source -> limit; the watchdog, and the hold of the offset.
proc errormotion_guard {} {
    set slew [errormotion_setting SLEW]
    set limit [errormotion_setting LIMIT]
    foreach each {alive thread} {
        setp errormotion-$each.rising 1
        setp errormotion-$each.falling 1
        setp errormotion-$each.retriggerable 1
    }
    setp errormotion-alive.width [errormotion_setting WATCHDOG]
    setp errormotion-thread.width 3
    net errormotion-sign errormotion-sign.out => errormotion-alive.in
    net errormotion-is-alive errormotion-alive.out => errormotion-fresh.in0
    errormotion_join_pin motion.motion-enabled errormotion-on.in0
    errormotion_join_pin motion.is-all-homed errormotion-on.in1
    net errormotion-is-on errormotion-on.out => errormotion-ready.in1
    net errormotion-is-on => errormotion-held.in1
    net errormotion-is-on => errormotion-off.in

    # A request from before the machine was switched off has no effect when it is switched on again.
    setp errormotion-asked.data 1
    net errormotion-sign => errormotion-asked.clk
    net errormotion-is-off errormotion-off.out => errormotion-asked.reset
    net errormotion-is-asked errormotion-asked.out => errormotion-fresh.in1
    net errormotion-is-fresh errormotion-fresh.out => errormotion-ready.in0

    # Hold while the machine probes (motion type 5), while a thread is cut (and 3 s after the last change of
    # errormotion-thread.in, by the bridge), and while the pin HOLD is true; only while the machine is on.
    errormotion_join_pin motion.motion-type errormotion-motion.sel
    net errormotion-probes errormotion-motion.out5 => errormotion-hold-1.in0
    net errormotion-threads errormotion-thread.out => errormotion-hold-1.in1
    net errormotion-hold-1 errormotion-hold-1.out => errormotion-hold-2.in0
    net errormotion-hold-2 errormotion-hold-2.out => errormotion-held.in0
    net errormotion-held errormotion-held.out => errormotion-slew.sel
    if {[info exists ::ERRORMOTION(HOLD)]} { errormotion_join_pin $::ERRORMOTION(HOLD) errormotion-hold-2.in1 }
    setp errormotion-slew.in0 $slew
    setp errormotion-slew.in1 0

    net errormotion-may-change errormotion-ready.out
    net errormotion-speed errormotion-slew.out
    foreach letter {x y z} {
        net errormotion-may-change => errormotion-source-$letter.sel
        net errormotion-speed => errormotion-limit-$letter.maxv
        setp errormotion-limit-$letter.min -$limit
        setp errormotion-limit-$letter.max $limit
        net errormotion-source-$letter errormotion-source-$letter.out => errormotion-limit-$letter.in
        net errormotion-offset-$letter errormotion-limit-$letter.out
    }
    foreach each {sign alive motion thread hold-1 hold-2 on off asked fresh held slew ready} {
        addf errormotion-$each servo-thread
    }
    foreach each [errormotion_names {source limit}] { addf $each servo-thread }
}

# LinuxCNC sums up the changes of eoffset-counts, only while the machine is on and homed, and sets its offset to zero
# when the machine is switched off. The offset here is also set to zero in this cycle: the motors are off.
proc errormotion_external {} {
    foreach letter {x y z} {
        errormotion_planner [string toupper $letter]
        net errormotion-is-off => errormotion-limit-$letter.load
        setp errormotion-scale-$letter.gain 1e7
        setp axis.$letter.eoffset-scale 1e-7
        setp axis.$letter.eoffset-enable 1
        net errormotion-offset-$letter => errormotion-scale-$letter.in
        net errormotion-scaled-$letter errormotion-scale-$letter.out => errormotion-counts-$letter.in
        net errormotion-counts-$letter errormotion-counts-$letter.out => axis.$letter.eoffset-counts
    }
    foreach each [errormotion_names {scale counts}] { addf $each servo-thread }
}

# Otherwise LinuxCNC's planner would be faster than SLEW when it restores an offset after an end of travel; a
# slower one would not follow.
proc errormotion_planner {axis} {
    upvar #0 AXIS_$axis section
    set fastest [expr {1.0 * [errormotion_setting SLEW] / $section(MAX_VELOCITY)}]
    set found [expr {[info exists section(OFFSET_AV_RATIO)] ? $section(OFFSET_AV_RATIO) : "none"}]
    if {![string is double -strict $found] || $found < 0.99 * $fastest || $found > 1.000001 * $fastest} {
        return -code error "compensation.tcl: expected \[AXIS_$axis\] OFFSET_AV_RATIO = $fastest (SLEW / MAX_VELOCITY,\
            rounded down by 1 % at most); found $found"
    }
}

# Each joint of X, Y or Z, by the letter of its axis in [TRAJ] COORDINATES.
proc errormotion_joints {part} {
    set found {}
    set joint 0
    foreach letter [split [string tolower [string map {" " ""} [join $::TRAJ(COORDINATES) ""]]] ""] {
        if {$letter in {x y z}} { lappend found errormotion-$part-$joint-$letter }
        incr joint
    }
    return $found
}

# The offset is added before the drives read the command: its function runs directly after motion-controller.
proc errormotion_feedback {} {
    thread_info threads
    set position [expr {$threads(servo-thread,motion-controller) + 1}]
    foreach name [concat [errormotion_joints command] [errormotion_joints feedback]] {
        lassign [split $name -] prefix part joint letter
        net errormotion-offset-$letter => $name.in1
        if {$part == "command"} {
            net [errormotion_cut joint.$joint.motor-pos-cmd $name.in0] <= $name.out
            addf $name servo-thread $position
        } else {
            setp $name.gain1 -1
            net [errormotion_cut joint.$joint.motor-pos-fb $name.out] => $name.in0
            addf $name servo-thread
        }
    }
}

proc errormotion_run {} {
    set route [errormotion_setting ROUTE]
    if {$route ni {external feedback}} {
        return -code error "compensation.tcl: expected \[ERRORMOTION\] ROUTE external or feedback; found $route"
    }
    set pass [expr {[namespace exists ::tp] ? [::tp::passnumber] : -1}]
    if {$pass < 1} { errormotion_components $route }
    if {$pass != 0} {
        errormotion_guard
        errormotion_$route
    }
}

errormotion_run
