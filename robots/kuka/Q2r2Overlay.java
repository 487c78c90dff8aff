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
 * Lets q2r2 command one arm by FRI. The cabinet holds the arm at its present posture, and adds the commands of q2r2 to
 * this position hold.
 *
 * <p>The position hold is the only motion that this application starts itself. On the smartPAD, the application asks
 * for all settings that differ between arms and runs. Before each start of the overlay, it asks whether to start. The
 * authors have neither compiled this application nor run it on an arm. Read it, and try it first in T1, without a tool,
 * with the emergency stop in your hand.
 *
 * <p>The names are those of Sunrise 1 with FRI 1.15 or newer. For Sunrise 2 and 3, docs/kuka.md says what to change.
 */
public class Q2r2Overlay extends RoboticsAPIApplication {

    // Addresses of the computer that runs q2r2. Enter yours here.
    private static final String[] ADDRESSES = {"172.31.1.148", "192.170.10.1"};
    // These ports are fri.left.port and fri.right.port in the cell.
    private static final String[] PORTS = {"30200", "30201"};
    // If q2r2 commands torques, the cabinet needs an answer at least every 5 ms.
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
        // Use these lines if the gripper is connected to inputs and outputs of the cabinet. Sunrise.Workbench generates
        // the class of the I/O group:
        // GripperIOGroup gripper = new GripperIOGroup(lbr.getController());
        // configuration.registerIO(gripper.getOutput("Opening"));   // fri.*.gripper.output: Gripper.Opening
        // configuration.registerIO(gripper.getInput("Measured"));   // fri.*.gripper.input: Gripper.Measured

        // From here on, the cabinet sends messages to q2r2, and the session is in the state monitoring.
        session = new FRISession(configuration);
        ClientCommandMode commands = torques ? ClientCommandMode.TORQUE : ClientCommandMode.POSITION;
        FRIJointOverlay overlay = new FRIJointOverlay(session, commands);
        getLogger().info("Sends to " + address + ", port " + port + ", every " + periodMs + " ms: " + commands);

        while (ask("Start the overlay? The arm is held where it stands, until q2r2 leads it.", "start", "end") == 0) {
            overlayOnce(overlay, torques ? softHold() : new PositionControlMode());
        }
    }

    /** Holds the arm at its present posture, and adds the commands of q2r2 until the session ends for any reason. */
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

    /** Returns an impedance mode without stiffness. The cabinet compensates gravity; q2r2 adds all other torques. */
    private static JointImpedanceControlMode softHold() {
        JointImpedanceControlMode mode = new JointImpedanceControlMode(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
        mode.setDampingForAllJoints(0.0);
        return mode;
    }

    /** Returns the index of the answer that was chosen on the smartPAD; the first answer has index 0. */
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
