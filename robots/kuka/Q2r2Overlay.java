package q2r2;

import static com.kuka.roboticsAPI.motionModel.BasicMotions.positionHold;

import java.util.concurrent.TimeUnit;
import java.util.concurrent.TimeoutException;

import javax.inject.Inject;

import com.kuka.connectivity.fastRobotInterface.ClientCommandMode;
import com.kuka.connectivity.fastRobotInterface.FRIConfiguration;
import com.kuka.connectivity.fastRobotInterface.FRIJointOverlay;
import com.kuka.connectivity.fastRobotInterface.FRISession;
import com.kuka.roboticsAPI.applicationModel.RoboticsAPIApplication;
import com.kuka.roboticsAPI.deviceModel.LBR;
import com.kuka.roboticsAPI.executionModel.CommandInvalidException;
import com.kuka.roboticsAPI.motionModel.controlModeModel.AbstractMotionControlMode;
import com.kuka.roboticsAPI.motionModel.controlModeModel.JointImpedanceControlMode;
import com.kuka.roboticsAPI.motionModel.controlModeModel.PositionControlMode;
import com.kuka.roboticsAPI.uiModel.ApplicationDialogType;

/**
 * Lets q2r2 command one arm by FRI: the cabinet holds the arm where it stands, and q2r2's commands come on top.
 *
 * <p>The application itself moves the arm nowhere: it has no motion but the hold. It asks at the smartPAD for all that
 * differs between arms and runs, and before each start of the overlay. It was compiled nowhere by those who wrote it,
 * and has run on no arm: read it, and try it first in T1, without a tool, with the emergency stop in your hand.
 *
 * <p>The names are those of Sunrise 1 with FRI 1.15 or newer. For Sunrise 2 and 3 docs/kuka.md says what to change.
 */
public class Q2r2Overlay extends RoboticsAPIApplication {

    // Addresses of the computer that runs q2r2: enter yours.
    private static final String[] ADDRESSES = {"172.31.1.148", "192.170.10.1"};
    // As fri.left.port and fri.right.port of the cell have them.
    private static final String[] PORTS = {"30200", "30201"};
    // Torques need an answer every 5 ms or more often.
    private static final String[] POSITION_PERIODS_MS = {"10", "5", "4", "2"};
    private static final String[] TORQUE_PERIODS_MS = {"5", "4", "2"};
    private static final int CLIENT_WAIT_MINUTES = 10;

    @Inject
    private LBR lbr;

    private FRISession session;

    @Override
    public void run() {
        boolean torques = ask("What does q2r2 command?", "positions", "torques (q2r2 run --mode torque)") == 1;
        String[] periods = torques ? TORQUE_PERIODS_MS : POSITION_PERIODS_MS;
        int periodMs = Integer.parseInt(periods[ask("Send period in ms; both arms need the same one", periods)]);
        String address = ADDRESSES[ask("Address of the computer that runs q2r2", ADDRESSES)];
        int port = Integer.parseInt(PORTS[ask("Port of this arm in the cell: left 30200, right 30201", PORTS)]);

        FRIConfiguration configuration = FRIConfiguration.createRemoteConfiguration(lbr, address);
        configuration.setSendPeriodMilliSec(periodMs);
        configuration.setReceiveMultiplier(1);
        configuration.setPortOnRemote(port);
        // For a gripper on inputs and outputs of the cabinet, of an I/O group that Workbench has generated:
        // GripperIOGroup gripper = new GripperIOGroup(lbr.getController());
        // configuration.registerIO(gripper.getOutput("Opening"));   // fri.*.gripper.output: Gripper.Opening
        // configuration.registerIO(gripper.getInput("Measured"));   // fri.*.gripper.input: Gripper.Measured

        session = new FRISession(configuration); // from here on the cabinet sends, and the session is in monitoring
        ClientCommandMode commands = torques ? ClientCommandMode.TORQUE : ClientCommandMode.POSITION;
        FRIJointOverlay overlay = new FRIJointOverlay(session, commands);
        getLogger().info("Sends to " + address + ", port " + port + ", every " + periodMs + " ms: " + commands);

        while (ask("Start the overlay? The arm is held where it stands, until q2r2 leads it.", "start", "end") == 0) {
            overlayOnce(overlay, torques ? softHold() : new PositionControlMode());
        }
    }

    /** Hold the arm where it stands, with q2r2's commands on top, until the session ends for whatever reason. */
    private void overlayOnce(FRIJointOverlay overlay, AbstractMotionControlMode mode) {
        try {
            getLogger().info("Waits for the answers of q2r2 run, up to " + CLIENT_WAIT_MINUTES + " minutes");
            session.await(CLIENT_WAIT_MINUTES, TimeUnit.MINUTES);
            getLogger().info("Connection: " + session.getFRIChannelInformation().getQuality());
            lbr.move(positionHold(mode, -1, TimeUnit.SECONDS).addMotionOverlay(overlay));
        } catch (TimeoutException noAnswers) {
            getLogger().error("q2r2 does not answer: is it running, and are address, port and firewall right?");
        } catch (CommandInvalidException ended) {
            getLogger().error("The session has ended: " + ended.getLocalizedMessage());
        }
    }

    /** No spring of the cabinet's own: it bears the weight, and all else comes from q2r2's torques. */
    private static JointImpedanceControlMode softHold() {
        JointImpedanceControlMode mode = new JointImpedanceControlMode(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
        mode.setDampingForAllJoints(0.0);
        return mode;
    }

    /** The number of the answer that was chosen at the smartPAD, from 0 on. */
    private int ask(String question, String... answers) {
        return getApplicationUI().displayModalDialog(ApplicationDialogType.QUESTION, question, answers);
    }

    @Override
    public void dispose() {
        if (session != null) {
            session.close();
        }
        super.dispose();
    }
}
